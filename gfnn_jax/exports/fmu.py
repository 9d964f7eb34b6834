"""A law as an FMU of FMI 3.0: co-simulation and model exchange.

Co-simulation steps by Taylor series to roundoff, over any communication step, with bodies that
stick; model exchange gives the rates, dry friction smoothed. The sources go along; the binary is
that of the machine that writes the file, where it has a C compiler.
"""

import hashlib
import io
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from gfnn_jax.errors import WorkError
from gfnn_jax.exports import c_parts
from gfnn_jax.exports.graph import LawGraph, graph_of
from gfnn_jax.exports.jax_source import rates_on_tape
from gfnn_jax.exports.symbols import literal
from gfnn_jax.exports.taylor import c_of_flow
from gfnn_jax.maps.symplectic_map import SymplecticMap

_UNSERVED = (  # functions that an FMU has to hold
    "InstantiateScheduledExecution ActivateModelPartition GetNumberOfVariableDependencies "
    "GetVariableDependencies GetDirectionalDerivative GetAdjointDerivative "
    "EnterConfigurationMode ExitConfigurationMode GetIntervalDecimal GetIntervalFraction "
    "GetShiftDecimal GetShiftFraction SetIntervalDecimal SetIntervalFraction SetShiftDecimal "
    "SetShiftFraction GetOutputDerivatives SerializedFMUStateSize SerializeFMUState "
    "DeserializeFMUState EvaluateDiscreteStates GetClock SetClock GetBinary SetBinary"
)
_TYPES = "Float32 Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Boolean String"


def fmu(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> bytes:
    """Make the FMU of the law of a map, a zip archive.

    Its states are z = (q, p), which start at 0, the q named as their columns; inputs and parameters
    of the system those of the map, coefficients tunable parameters ``c1``, ``c2``, …; the time of a
    drive is that of the simulation. Inputs are held during a step. Raises InputError for a map
    without a law, or with one that is no formula, WorkError without a C compiler.
    """
    graph = graph_of(map_)
    text = _source(graph, graph_of(map_, sharp=False), _starts(graph, map_))
    token = hashlib.sha256(text.encode()).hexdigest()[:32]
    text = text.replace("TOKEN", f'"{token}"', 1)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", _description(graph, map_, name, token, about))
        archive.writestr(f"sources/{name}.c", text)
        archive.writestr("sources/buildDescription.xml", _build(name))
        archive.writestr(*_compiled(text, name))
    return packed.getvalue()


def _compiled(text: str, name: str) -> tuple[str, bytes]:
    """The binary's path and content. Raises WorkError without a compiler."""
    if shutil.which("cc") is None:
        raise WorkError("an FMU needs the C compiler cc, which is not installed; --to c needs none")
    machine = {"arm64": "aarch64", "AMD64": "x86_64"}.get(platform.machine(), platform.machine())
    system = platform.system().lower()
    suffix = {"darwin": ".dylib", "windows": ".dll"}.get(system, ".so")
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / f"{name}.c", Path(folder) / f"{name}{suffix}"
        source.write_text(text, encoding="utf-8")
        command = ["cc", "-O2", "-std=c99", "-fPIC", "-shared", str(source), "-o", str(library)]
        subprocess.run([*command, "-lm"], check=True, capture_output=True)
        return f"binaries/{machine}-{system}/{name}{suffix}", library.read_bytes()


def _source(graph: LawGraph, smooth: LawGraph, starts: list[float]) -> str:
    """Write the C of the FMU: ours, and the interface about it."""
    tape, found = rates_on_tape(smooth)
    rates = tape.function("rates_of", {"r": found})
    count, coefficients = len(graph.arguments), len(graph.values)
    time = "" if graph.time is None else f"    one->u[{graph.time}] = one->time;\n"
    stubs = [f"STUB(fmi3{own})" for own in _UNSERVED.split()]
    stubs += [f"STUB(fmi3{way}{kind})" for kind in _TYPES.split() for way in ("Get", "Set")]
    nominals, begun = (", ".join(map(literal, a)) for a in (graph.scale, starts))
    return f"""\
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
{c_parts.INCLUDES}
{c_of_flow(graph, coefficients=True, unrolled=False)}
{rates}
/* The interface of FMI 3.0, https://fmi-standard.org. */
#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#endif
#define STUB(name) EXPORT int name(void) {{ return ERROR; }}
enum {{ DONE = 0, ERROR = 3, COUNT = 1 + 2*WIDTH + {count + coefficients} }};

struct one {{
    double time, z[WIDTH], u[{max(graph.num_given, 1)}], p[{max(coefficients, 1)}];
}};

static const struct one begun = {{0.0, {{0.0}}, {{{begun}}}, {{{
        ", ".join(map(literal, graph.values)) or "0.0"
    }}}}};

static double *place(struct one *one, uint32_t reference)
{{
    if (reference == 0)
        return &one->time;
    if (reference <= WIDTH)
        return one->z + reference - 1;
    if (reference > 2*WIDTH && reference <= 2*WIDTH + {count})
        return one->u + reference - 2*WIDTH - 1;
    return one->p + reference - 2*WIDTH - {count} - 1;
}}

static void derivatives(struct one *one, double *r)
{{
{time}    rates_of(one->z, one->u, one->p, r);
}}

EXPORT const char *fmi3GetVersion(void) {{ return "3.0"; }}
EXPORT int fmi3SetDebugLogging(void *one, bool on, size_t n, const char *const *names)
{{ (void)one; (void)on; (void)n; (void)names; return DONE; }}

static void *made(const char *token)
{{
    struct one *one = NULL;
    if (strcmp(token, TOKEN) == 0)
        one = malloc(sizeof *one);
    if (one)
        *one = begun;
    return one;
}}

EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *path,
    bool visible, bool on, void *environment, void *message)
{{ (void)name; (void)path; (void)visible; (void)on; (void)environment; (void)message;
   return made(token); }}
EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *path,
    bool visible, bool on, bool events, bool early, const uint32_t *needed, size_t n,
    void *environment, void *message, void *update)
{{ (void)name; (void)path; (void)visible; (void)on; (void)events; (void)early; (void)needed;
   (void)n; (void)environment; (void)message; (void)update; return made(token); }}
EXPORT void fmi3FreeInstance(void *one) {{ free(one); }}
EXPORT int fmi3EnterInitializationMode(void *one, bool known, double tolerance, double start,
    bool ends, double stop)
{{ (void)known; (void)tolerance; (void)ends; (void)stop; ((struct one *)one)->time = start;
   return DONE; }}
EXPORT int fmi3ExitInitializationMode(void *one) {{ (void)one; return DONE; }}
EXPORT int fmi3EnterEventMode(void *one) {{ (void)one; return DONE; }}
EXPORT int fmi3EnterStepMode(void *one) {{ (void)one; return DONE; }}
EXPORT int fmi3EnterContinuousTimeMode(void *one) {{ (void)one; return DONE; }}
EXPORT int fmi3Terminate(void *one) {{ (void)one; return DONE; }}
EXPORT int fmi3Reset(void *one) {{ *(struct one *)one = begun; return DONE; }}

EXPORT int fmi3GetFloat64(void *one, const uint32_t *references, size_t n, double *values,
    size_t num)
{{
    double r[WIDTH];
    derivatives(one, r);
    for (size_t i = 0; i < n && i < num; i++) {{
        const uint32_t at = references[i];
        if (at >= COUNT)
            return ERROR;
        values[i] = at > WIDTH && at <= 2*WIDTH ? r[at - WIDTH - 1] : *place(one, at);
    }}
    return DONE;
}}

EXPORT int fmi3SetFloat64(void *one, const uint32_t *references, size_t n, const double *values,
    size_t num)
{{
    for (size_t i = 0; i < n && i < num; i++) {{
        const uint32_t at = references[i];
        if (at >= COUNT || (at > WIDTH && at <= 2*WIDTH))
            return ERROR;
        *place(one, at) = values[i];
    }}
    return DONE;
}}

EXPORT int fmi3GetFMUState(void *one, void **state)
{{
    if (!*state)
        *state = malloc(sizeof begun);
    if (!*state)
        return ERROR;
    memcpy(*state, one, sizeof begun);
    return DONE;
}}
EXPORT int fmi3SetFMUState(void *one, void *state)
{{ memcpy(one, state, sizeof begun); return DONE; }}
EXPORT int fmi3FreeFMUState(void *one, void **state)
{{ (void)one; free(*state); *state = NULL; return DONE; }}

EXPORT int fmi3UpdateDiscreteStates(void *one, bool *update, bool *ends, bool *nominals,
    bool *values, bool *timed, double *next)
{{ (void)one; (void)next; *update = *ends = *nominals = *values = *timed = false; return DONE; }}
EXPORT int fmi3CompletedIntegratorStep(void *one, bool final, bool *event, bool *ends)
{{ (void)one; (void)final; *event = *ends = false; return DONE; }}
EXPORT int fmi3SetTime(void *one, double time)
{{ ((struct one *)one)->time = time; return DONE; }}
EXPORT int fmi3SetContinuousStates(void *one, const double *z, size_t n)
{{ memcpy(((struct one *)one)->z, z, n*sizeof *z); return DONE; }}
EXPORT int fmi3GetContinuousStates(void *one, double *z, size_t n)
{{ memcpy(z, ((struct one *)one)->z, n*sizeof *z); return DONE; }}
EXPORT int fmi3GetContinuousStateDerivatives(void *one, double *r, size_t n)
{{ (void)n; derivatives(one, r); return DONE; }}
EXPORT int fmi3GetNominalsOfContinuousStates(void *one, double *nominals, size_t n)
{{
    static const double of[WIDTH] = {{{nominals}}};
    (void)one;
    memcpy(nominals, of, n*sizeof *of);
    return DONE;
}}
EXPORT int fmi3GetNumberOfContinuousStates(void *one, size_t *n)
{{ (void)one; *n = WIDTH; return DONE; }}
EXPORT int fmi3GetNumberOfEventIndicators(void *one, size_t *n)
{{ (void)one; *n = 0; return DONE; }}
EXPORT int fmi3GetEventIndicators(void *one, double *values, size_t n)
{{ (void)one; (void)values; (void)n; return DONE; }}

EXPORT int fmi3DoStep(void *instance, double time, double step, bool final, bool *event, bool *ends,
    bool *early, double *last)
{{
    struct one *one = instance;
    (void)final;
    *event = *ends = *early = false;
    one->time = time;
{time}    const int status = flow(one->z, step, one->u, one->p);
    if (status == OK)
        one->time = time + step;
    *last = one->time;
    return status == OK ? DONE : ERROR;
}}

{chr(10).join(stubs)}
"""


def _starts(graph: LawGraph, map_: SymplecticMap) -> list[float]:
    """Values that u begins with: of parameters the middle of the data, of inputs 0."""
    found, parameters = [0.0] * max(graph.num_given, 1), map_.parameters
    if parameters is not None:
        middles = 0.5 * (np.asarray(parameters.low) + np.asarray(parameters.high))
        found[: len(middles)] = middles.tolist()
    return found


def _variable(name: str, reference: int, **attributes: Any) -> str:
    listed = " ".join(f"{key}={quoteattr(str(value))}" for key, value in attributes.items())
    return f'    <Float64 name={quoteattr(name)} valueReference="{reference}" {listed}/>'


def _description(
    graph: LawGraph, map_: SymplecticMap, name: str, token: str, about: Mapping[str, Any]
) -> str:
    width, dim, sensors = len(graph.rates), graph.dim, map_.sensors
    shown = sensors.positions if sensors is not None else graph.names[:dim]
    told = [*shown, *(f"momentum of {q}" for q in shown)]
    names = [*shown, *graph.names[dim:]]  # as the columns, where these are free
    others = {"time", *graph.arguments, *(f"c{k + 1}" for k in range(len(graph.terms)))}
    if len({*names} - others) < width:
        names = graph.names
    rows = [_variable("time", 0, causality="independent", variability="continuous")]
    for i, (own, text) in enumerate(zip(names, told, strict=True)):
        exact = {"initial": "exact", "start": 0.0, "nominal": f"{graph.scale[i]:.3g}"}
        rows.append(_variable(own, 1 + i, causality="output", description=text, **exact))
    for i, own in enumerate(names):
        outside = "output" if i < dim else "local"
        rows.append(_variable(f"der({own})", 1 + width + i, causality=outside, derivative=1 + i))
    first = 1 + 2 * width
    parameters, starts = map_.parameters, _starts(graph, map_)
    for i, own in enumerate(graph.arguments):
        if i == graph.time:
            continue
        of_system = parameters is not None and i < len(parameters.names)
        kind, how = ("parameter", "tunable") if of_system else ("input", "continuous")
        start = repr(starts[i])
        rows.append(_variable(own, first + i, causality=kind, variability=how, start=start))
    for k, (term, value) in enumerate(zip(graph.terms, graph.values.tolist(), strict=True)):
        kind = {"causality": "parameter", "variability": "tunable", "start": repr(value)}
        place = first + len(graph.arguments) + k
        rows.append(_variable(f"c{k + 1}", place, description=term, **kind))
    outputs = [*range(1, 1 + width), *range(1 + width, 1 + width + dim)]
    structure = [f'    <Output valueReference="{n}"/>' for n in outputs]
    for key in ("ContinuousStateDerivative", "InitialUnknown"):
        structure += [f'    <{key} valueReference="{1 + width + i}"/>' for i in range(width)]
    text = "; ".join(f"{key}: {value}" for key, value in about.items())
    variables, listed = "\n".join(rows), "\n".join(structure)
    return f"""\
<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName={quoteattr(name)} instantiationToken="{token}"
    description={quoteattr(text)} variableNamingConvention="flat">
  <ModelExchange modelIdentifier="{name}" canGetAndSetFMUState="true"/>
  <CoSimulation modelIdentifier="{name}" canGetAndSetFMUState="true"
      canHandleVariableCommunicationStepSize="true"/>
  <DefaultExperiment stepSize="{literal(graph.dt)}"/>
  <ModelVariables>
{variables}
  </ModelVariables>
  <ModelStructure>
{listed}
  </ModelStructure>
</fmiModelDescription>
"""


def _build(name: str) -> str:
    return f"""\
<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="{name}">
    <SourceFileSet language="C99">
      <SourceFile name="{name}.c"/>
    </SourceFileSet>
    <Library name="m"/>
  </BuildConfiguration>
</fmiBuildDescription>
"""
