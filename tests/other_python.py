"""Python in processes of its own: run to its end, killed at random and started again, several that
share a job."""

import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path


def run_python(code, *args, devices=None, **variables):
    """What code writes that runs with these arguments and the modules that tests import, on so many
    devices where ``devices`` tells; it must end well."""
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    env = os.environ | {"PYTHONPATH": path} | variables
    if devices:
        count = f" --xla_force_host_platform_device_count={devices}"
        env["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + count
    command = [sys.executable, "-c", code, *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    return done.stdout


def killed_and_resumed(code, path, kills, seed, longest):
    """Number of times that code, which says that it has started, was killed, each within so many
    seconds, before it came to its end."""
    rng, killed = random.Random(seed), 0
    for _ in range(50 * max(kills, 1)):
        command = [sys.executable, "-c", code, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "started\n"
            if killed < kills:
                time.sleep(rng.uniform(0, longest))
                process.send_signal(signal.SIGKILL)
            status = process.wait()
        killed += status == -signal.SIGKILL
        if status == 0:
            return killed
    raise AssertionError("never finished")


def port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def started(*command, count=2, **flags):
    """Start ``count`` processes that share a command of gfnn. flags: of their environment."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_") or "CACHE" in k}
    kept |= {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port()}", "JAX_NUM_PROCESSES": str(count)}
    kept |= {"PYTHONPATH": os.pathsep.join(sys.path)} | flags
    words = [sys.executable, "-m", "gfnn_jax", *map(str, command), "--distributed"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return [
        subprocess.Popen(words, env=kept | {"JAX_PROCESS_ID": str(i)}, **pipes)
        for i in range(count)
    ]


def ended(running):
    """(status, stdout, stderr) of each."""
    told = [process.communicate(timeout=100) for process in running]
    return [(p.returncode, *texts) for p, texts in zip(running, told, strict=True)]
