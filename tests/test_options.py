"""Options of a fit have one home, from which Python, the command line and jobs take them."""

import dataclasses
import inspect
import json

import gfnn_jax as gfnn
from gfnn_jax import cli_parser
from gfnn_jax.learn.options import OPTIONS

FIELDS = {field.name: field.default for field in dataclasses.fields(gfnn.FitOptions)}


def test_each_is_a_keyword_of_the_fit_with_its_default():
    shown = inspect.signature(gfnn.fit).parameters
    assert {n: shown[n].default for n in FIELDS} == FIELDS
    assert all(f"{name}: {about.help}" in str(gfnn.fit.__doc__) for name, about in OPTIONS.items())


def test_the_command_line_reads_what_python_takes():
    given = ["--tolerance", "1e-3", "--seed", "7", "--devices", "all", "--max-seconds", "5"]
    given += ["--max-operations", "9", "--structure", "ring:2", "--terms", "p1**2; cos(q1)"]
    arguments = cli_parser.parser().parse_args(["fit", "data.npz", "--out", "model", *given])
    assert gfnn.FitOptions(**cli_parser.fit_options(arguments)) == gfnn.FitOptions(
        tolerance=1e-3,
        terms=("p1**2", "cos(q1)"),
        seed=7,
        devices="all",
        max_seconds=5.0,
        max_operations=9,
        structure="ring:2",
    )
    of_run = cli_parser.parser().parse_args(["run", "two-body", "--family", "mlp"])
    assert cli_parser.fit_options(of_run) == {"family": "mlp"}


def test_a_job_is_identified_by_what_decides_its_model():
    options = gfnn.FitOptions(terms=("p1**2",), angles=(0,), max_seconds=3.0, devices=2)
    assert json.loads(json.dumps(options.deciding)) == options.deciding
    unasked = {"bracket", "hidden"}  # canonical pairs and plain recordings have none
    others = {"max_seconds", "max_operations", "devices", *unasked}
    assert set(FIELDS) - set(options.deciding) == others
