"""Compiled loops: plain functions of numbers and arrays in machine code, by LLVM.

Functions marked by `function`, and the one that Python calls, marked by `compiled`, are written in
a small part of Python: whole and floating numbers, contiguous arrays of both, tuples of them, and
loops over them. What they mean is what Python means by them, except that no place in an array is
checked, that none counts from the end, and that division by zero and functions outside their domain
make what NumPy makes of them; all else is refused. Called from Python, a `function` is plain Python
still.
Arrays that are written to overlap no others.

The code of one such function and of all that it calls is written down for LLVM as one module,
optimised once, for this processor, and kept on disk by what it was made from. numba does the same
with all of Python, for ten times the seconds. This module alone imports llvmlite.
"""

import ast
import ctypes
import hashlib
import inspect
import math
import os
import struct
import sys
import tempfile
import textwrap
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from gfnn_jax import compiling

BOOL, WHOLE, FLOAT = "i1", "i64", "double"
_WIDER = {BOOL: 0, WHOLE: 1, FLOAT: 2}
_ELEMENTS = {"l": WHOLE, "q": WHOLE, "d": FLOAT}
_INTRINSIC = {"fabs": "fabs"} | dict.fromkeys(("sin", "cos", "exp", "log", "sqrt", "rint"), "")
_OF_C = {"tan": 1, "sinh": 1, "cosh": 1, "tanh": 1, "atan": 1, "hypot": 2}
# What LLVM makes of loops, and of a sine beside a cosine: each platform has some of these.
_OF_LLVM = ("sincos", "__sincos_stret", "memcpy", "memmove", "memset", "bzero", "__bzero")
_WORDS = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul"}
_ORDERS = {ast.Lt: "lt", ast.LtE: "le", ast.Gt: "gt", ast.GtE: "ge", ast.Eq: "eq", ast.NotEq: "ne"}
_lock = threading.RLock()  # of compilation
_engines: list[Any] = []  # the code that they hold is in use as long as the process lives


class Number(NamedTuple):
    """A number: its type and the name by which LLVM knows it."""

    type: str
    name: str


class Array(NamedTuple):
    """A contiguous array: the type of its numbers, its place and its shape."""

    type: str
    place: str
    shape: tuple[Number, ...]


class Parts(NamedTuple):
    """A tuple; of a named one the names."""

    items: tuple[Any, ...]
    names: tuple[str, ...] = ()


def function(plain: Callable) -> Callable:
    """Mark a function that compiled ones call."""
    plain.__dict__["compiled"] = True
    return plain


class Compiled:
    """A function whose loops run as machine code; ``plain`` is the same in Python.

    Arrays that are given to it must be contiguous and writeable. It is compiled once for each
    combination of the types of its arguments.
    """

    def __init__(self, plain: Callable, what: str, seconds: int):
        self.plain, self._said = plain, f"{what} (about {seconds} s)"
        self.made: dict[tuple, Callable] = {}

    def __call__(self, *arguments: Any) -> None:
        """Run on arrays, whole numbers, and tuples of them.

        Raises ValueError for an array that is not contiguous and writeable.
        """
        kinds: list[Any] = []
        numbers: list[int] = []
        for argument in arguments:
            _laid_out(argument, kinds, numbers)
        made = self.made.get(key := tuple(kinds))
        if made is None:
            with _lock:
                made = self.made.get(key) or self._compiled(key, arguments)
                self.made[key] = made
        made(struct.pack(f"{len(numbers)}q", *numbers))

    def _compiled(self, key: tuple, arguments: tuple) -> Callable:
        made_of = [self.plain, *_called(self.plain)]
        files = sorted({inspect.getfile(f) for f in made_of} | {__file__})
        text = "\0".join([*(Path(file).read_text(encoding="utf-8") for file in files), repr(key)])
        processor = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
        name = self.plain.__name__
        text = "\0".join([name, text, llvmlite.__version__, *processor])
        folder = _folder()
        kept = folder and folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:32]}.o"
        try:
            code = b"" if kept is None else kept.read_bytes()
        except OSError:
            code = b""
        machine = _machine()
        if not code:
            compiling.say(f"compiling, once on this machine, {self._said}")
            try:
                code = machine.emit_object(_optimised(_module(self.plain, arguments), machine))
            finally:
                compiling.say("")
            if kept is not None:
                _keep(kept, code)
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        _engines.append(engine)
        made = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(engine.get_function_address("entry"))
        return made


def compiled(what: str, seconds: int) -> Callable[[Callable], Compiled]:
    """Compile a function that Python calls; say what it is and how long that takes."""
    return lambda plain: Compiled(plain, what, seconds)


def _laid_out(argument: Any, kinds: list, numbers: list[int]) -> None:
    """Append the type of an argument, and the numbers that tell the code where it is."""
    if isinstance(argument, np.ndarray):
        if not argument.flags.carray:
            raise ValueError("compiled code takes contiguous arrays that may be written")
        kinds.append((argument.dtype.char, argument.ndim))
        # A fifteenth of the time of ``argument.ctypes.data``; an empty array has no place.
        buffer: Any = argument
        place = ctypes.addressof(ctypes.c_byte.from_buffer(buffer)) if argument.size else 0
        numbers.append(place)
        numbers += argument.shape
    elif isinstance(argument, tuple):
        kinds.append(len(argument))
        for one in argument:
            _laid_out(one, kinds, numbers)
    else:
        kinds.append(WHOLE)
        numbers.append(int(argument))


# The code on disk


@cache
def _folder() -> Path | None:
    """Find where compiled code is kept: the user's cache, or a temporary folder where that cannot
    be written; None where that cannot be either."""
    try:
        user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gfnn_jax"
        user.mkdir(parents=True, exist_ok=True)
        if os.access(user, os.W_OK):
            return user
    except (OSError, RuntimeError):
        pass
    number = getattr(os, "getuid", int)()
    folder = Path(tempfile.gettempdir()) / f"gfnn_jax-{number}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        made = folder.stat()
        if made.st_uid == number and not made.st_mode & 0o022:  # others might change what runs
            return folder
    except OSError:
        pass
    print("no folder can be written: the motion of laws is compiled anew", file=sys.stderr)
    return None


def _keep(kept: Path, code: bytes) -> None:
    """Write code in one step: other processes may read or write the same meanwhile."""
    try:
        with tempfile.NamedTemporaryFile(dir=kept.parent, delete=False) as file:
            file.write(code)
        os.replace(file.name, kept)
    except OSError as error:
        print(f"compiled code could not be kept ({error})", file=sys.stderr)


# LLVM


@cache
def _library() -> dict[str, int]:
    """Addresses of C's functions that compiled code may call: LLVM ends the process where one that
    it looks for itself is missing."""
    files = ("ucrtbase.dll", "vcruntime140.dll") if os.name == "nt" else (None,)  # the process
    libraries = [ctypes.CDLL(file) for file in files]
    found = {}
    for name in ("copysign", "pow", *_INTRINSIC, *_OF_C, *_OF_LLVM):
        for library in libraries:
            if hasattr(library, name):
                found[name] = ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0
    return found


@cache
def _machine() -> Any:
    """Describe this processor to LLVM."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    for name, place in _library().items():
        llvm.add_symbol(name, place)
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        reloc="static" if target.name.startswith("x86") else "default",
        jit=True,
    )


def _optimised(text: str, machine: Any) -> Any:
    """The module of a text, optimised for this processor."""
    module = llvm.parse_assembly(text)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization = True
    options.loop_vectorization = True
    options.loop_interleaving = False  # of short loops
    options.loop_unrolling = False
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    return module


def _module(plain: Callable, arguments: tuple) -> str:
    """A module of a function, of all that it calls, and of ``entry``, which calls it with arguments
    that stand one after another from the place that it is given."""
    unit = _Unit()
    lines: list[str] = []
    given = tuple(_given(argument, lines) for argument in arguments)
    name, _ = unit.of(plain, given)
    listed = ", ".join(f"{kind} {value}" for kind, value in _flat(given))
    entry = ["define void @entry(ptr %given) {", *lines, f"call void @{name}({listed})"]
    return "\n".join([*sorted(unit.declared), *unit.texts, *entry, "ret void", "}"])


def _given(argument: Any, lines: list[str]) -> Any:
    """Load an argument of ``entry``."""

    def loaded(kind: str) -> str:
        k = len(lines) // 2
        lines.append(f"%p{k} = getelementptr i64, ptr %given, i64 {k}")
        lines.append(f"%g{k} = load {kind}, ptr %p{k}")
        return f"%g{k}"

    if isinstance(argument, np.ndarray):
        place = loaded("ptr")
        shape = tuple(Number(WHOLE, loaded(WHOLE)) for _ in argument.shape)
        return Array(_ELEMENTS[argument.dtype.char], place, shape)
    if isinstance(argument, tuple):
        items = tuple(_given(one, lines) for one in argument)
        return Parts(items, getattr(argument, "_fields", ()))
    return Number(WHOLE, loaded(WHOLE))


def _flat(values: Any) -> list[tuple[str, str]]:
    """Types and names of all numbers and places in values."""
    found = []
    for value in values:
        if isinstance(value, Parts):
            found += _flat(value.items)
        elif isinstance(value, Array):
            found += [("ptr", value.place), *_flat(value.shape)]
        else:
            found.append(tuple(value))
    return found


def _kind(value: Any) -> Any:
    """The type of a value, by which functions are translated once."""
    if isinstance(value, Parts):
        return (*map(_kind, value.items), value.names)
    return (value.type, len(value.shape)) if isinstance(value, Array) else value.type


def _tree(plain: Callable) -> Any:
    return ast.parse(textwrap.dedent(inspect.getsource(plain))).body[0]


def _called(plain: Callable, found: dict | None = None) -> list[Callable]:
    """All functions that a function calls."""
    found = {} if found is None else found
    for name in plain.__code__.co_names:
        of: Any = plain.__globals__.get(name)
        if getattr(of, "compiled", False) and of not in found:
            found[of] = None
            _called(of, found)
    return list(found)


class _Unit:
    """A module: its functions, each once for the types that it is called with."""

    def __init__(self):
        self.texts: list[str] = []
        self.declared: set[str] = set()
        self.known: dict[tuple, tuple[str, Any]] = {}

    def of(self, plain: Callable, values: tuple) -> tuple[str, Any]:
        """The name of a function of such values, and the type of what it returns."""
        key = plain, *map(_kind, values)
        if key not in self.known:
            name = f"{plain.__name__}.{len(self.known)}"
            self.known[key] = name, _Translator(self, plain, values).written(name)
        return self.known[key]


class _Translator:
    """One function, statement by statement. Names stand for places of numbers, whose types are the
    widest of what is put there, found by writing the function again until none widens."""

    def __init__(self, unit: _Unit, plain: Callable, values: tuple):
        self.unit, self.plain, self.tree = unit, plain, _tree(plain)
        self.types: dict[str, str] = {}
        self.returned: Any = None
        self.given: list[tuple[str, str]] = []
        names = [argument.arg for argument in self.tree.args.args]
        self.arguments = dict(zip(names, map(self._named, values), strict=True))

    def _named(self, value: Any) -> Any:
        """A value with names of its own, an argument."""

        def name(kind: str) -> str:
            self.given.append((kind, f"%a{len(self.given)}"))
            return self.given[-1][1]

        if isinstance(value, Parts):
            return Parts(tuple(map(self._named, value.items)), value.names)
        if isinstance(value, Array):
            place = name("ptr noalias")
            return Array(value.type, place, tuple(Number(WHOLE, name(WHOLE)) for _ in value.shape))
        return Number(value.type, name(value.type))

    def written(self, name: str) -> Any:
        """Put the function into the module; the type that it returns."""
        before = None
        while before != (self.types, self.returned):
            before = dict(self.types), self.returned
            self.lines: list[str] = []
            self.count, self.open, self.bare, self.loops = 0, True, False, []
            self.names: dict[str, Any] = {}
            for argument, value in self.arguments.items():
                self.assign_name(argument, value)
            self.body(self.tree.body)
        kind = self.returned
        if kind is not None and (self.open or self.bare):
            raise self.refused(self.tree)  # it returns a number at some ends alone
        if self.open:
            self.lines.append("ret void")
        listed = ", ".join(f"{of} {at}" for of, at in self.given)
        rooms = [f"%v.{at} = alloca {of}" for at, of in self.types.items()]
        head = f"define internal {_struct(kind)} @{name}({listed}) nounwind {{"
        self.unit.texts.append("\n".join([head, "begin:", *rooms, *self.lines, "}"]))
        return kind

    # Lines

    def put(self, text: str) -> str:
        """Write a line whose result gets a name."""
        self.count += 1
        self.lines.append(f"%t{self.count} = {text}")
        return f"%t{self.count}"

    def label(self) -> str:
        self.count += 1
        return f"b{self.count}"

    def go(self, label: str) -> None:
        """End a block by a jump, if nothing has ended it."""
        if self.open:
            self.lines.append(f"br label %{label}")
        self.open = False

    def begin(self, label: str) -> None:
        self.go(label)
        self.lines.append(f"{label}:")
        self.open = True

    def branch(self, test: Number, yes: str, no: str) -> None:
        self.lines.append(f"br i1 {self.cast(test, BOOL).name}, label %{yes}, label %{no}")
        self.open = False

    def cast(self, value: Number, kind: str) -> Number:
        if value.type == kind:
            return value
        if kind == BOOL:
            zero = "fcmp une double" if value.type == FLOAT else "icmp ne i64"
            last = "0.0" if value.type == FLOAT else "0"
            return Number(BOOL, self.put(f"{zero} {value.name}, {last}"))
        if kind == WHOLE:
            word = "zext" if value.type == BOOL else "fptosi"
        else:
            word = "uitofp" if value.type == BOOL else "sitofp"
        return Number(kind, self.put(f"{word} {value.type} {value.name} to {kind}"))

    def alike(self, *values: Number) -> tuple[str, list[Number]]:
        kind = _widest(*(value.type for value in values))
        return kind, [self.cast(value, kind) for value in values]

    # Statements

    def body(self, statements: list[Any]) -> None:
        for statement in statements:
            if self.open:
                self.statement(statement)

    def statement(self, node: Any) -> None:
        match node:
            case ast.Expr(value=ast.Constant()):
                pass
            case ast.Expr(value=value):
                self.value(value)
            case ast.Assign(targets=targets, value=value):
                found = self.value(value)
                for target in targets:
                    self.assign(target, found)
            case ast.AugAssign(target=target, op=op, value=value):
                begun = self.value(target)
                self.assign(target, self.operated(node, type(op), begun, self.value(value)))
            case ast.If(test=test, body=body, orelse=other):
                self.chosen(test, lambda: self.body(body), lambda: self.body(other))
            case ast.For(
                target=ast.Name(id=name),
                iter=ast.Call(func=ast.Name(id="range"), args=bounds, keywords=[]),
                body=body,
                orelse=[],
            ):
                values = [self.value(bound) for bound in bounds]
                if any(value.type == FLOAT for value in values) or not _is_step(values[2:]):
                    raise self.refused(node.iter)
                self.counted(name, values, body)
            case ast.While(test=test, body=body, orelse=[]):
                begin, inside, end = self.label(), self.label(), self.label()
                self.begin(begin)
                self.branch(self.value(test), inside, end)
                self.looped(inside, body, begin, end)
                self.begin(end)
            case ast.Break() | ast.Continue():
                self.go(self.loops[-1][isinstance(node, ast.Break)])
            case ast.Return(value=value):
                self.give(None if value is None else self.value(value))
            case _:
                raise self.refused(node)

    def refused(self, node: Any) -> TypeError:
        line = self.plain.__code__.co_firstlineno + getattr(node, "lineno", 1) - 1
        return TypeError(f"{self.plain.__name__}, line {line}: {ast.unparse(node)} has no code")

    def chosen(self, test: Any, yes: Callable[[], object], no: Callable[[], object]) -> None:
        first, second, end = self.label(), self.label(), self.label()
        self.branch(self.value(test), first, second)
        opened = False
        for label, what in ((first, yes), (second, no)):
            self.begin(label)
            what()
            opened = opened or self.open
            self.go(end)
        if opened:
            self.begin(end)

    def looped(self, inside: str, body: Any, again: str, end: str) -> None:
        self.loops.append((again, end))
        self.begin(inside)
        self.body(body)
        self.go(again)
        self.loops.pop()

    def counted(self, name: str, bounds: list[Number], body: Any) -> None:
        """A loop over range."""
        start, stop, by = (
            [Number(WHOLE, "0")] * (len(bounds) == 1) + bounds + [Number(WHOLE, "1")]
        )[:3]
        self.count += 1
        counter = f"{name}.{self.count}"
        test, inside, after, end = self.label(), self.label(), self.label(), self.label()
        self.assign_name(counter, start)
        self.begin(test)
        now = self.load(counter)
        order = "sgt" if by.name.startswith("-") else "slt"
        self.branch(
            Number(BOOL, self.put(f"icmp {order} i64 {now.name}, {stop.name}")), inside, end
        )
        self.begin(inside)
        self.assign_name(name, now)
        self.looped(self.label(), body, after, end)
        self.begin(after)
        self.assign_name(counter, Number(WHOLE, self.put(f"add nsw i64 {now.name}, {by.name}")))
        self.go(test)
        self.begin(end)

    def give(self, value: Any) -> None:
        """Return a value."""
        if value is None:
            self.bare = True
            self.lines.append("ret void")
        elif isinstance(value, Parts):
            kinds, whole = tuple(item.type for item in value.items), "undef"
            self.returned = kinds
            for k, item in enumerate(value.items):
                whole = self.put(
                    f"insertvalue {_struct(kinds)} {whole}, {item.type} {item.name}, {k}"
                )
            self.lines.append(f"ret {_struct(kinds)} {whole}")
        else:
            self.returned = _widest(value.type, self.returned or BOOL)
            self.lines.append(f"ret {self.returned} {self.cast(value, self.returned).name}")
        self.open = False

    def assign(self, target: Any, value: Any) -> None:
        match target:
            case ast.Name(id=name):
                number = isinstance(value, Number)
                if value is None or name in self.names or (name in self.types and not number):
                    raise self.refused(target)  # names of arrays stand for one array
                self.assign_name(name, value)
            case ast.Tuple(elts=targets):
                for one, item in zip(targets, value.items, strict=True):
                    self.assign(one, item)
            case ast.Subscript(value=of, slice=ast.Slice(lower=None, upper=None, step=None)):
                self.fill(self.value(of), value)
            case ast.Subscript():
                array, place = self.place(self.value(target.value), target.slice)
                if array.shape:
                    raise self.refused(target)
                value = self.cast(value, array.type)
                self.lines.append(f"store {array.type} {value.name}, ptr {place}")
            case _:
                raise self.refused(target)

    def assign_name(self, name: str, value: Any) -> None:
        if not isinstance(value, Number):
            self.names[name] = value
            return
        self.types[name] = _widest(value.type, self.types.get(name, BOOL))
        value = self.cast(value, self.types[name])
        self.lines.append(f"store {value.type} {value.name}, ptr %v.{name}")

    def load(self, name: str) -> Number:
        kind = self.types[name]
        return Number(kind, self.put(f"load {kind}, ptr %v.{name}"))

    def fill(self, array: Array, value: Number) -> None:
        """Put a number into all places of an array."""
        size = Number(WHOLE, "1")
        for length in array.shape:
            size = self.arithmetic(ast.Mult, size, length)
        value = self.cast(value, array.type)
        self.assign_name("each", Number(WHOLE, "0"))
        test, inside, end = self.label(), self.label(), self.label()
        self.begin(test)
        now = self.load("each")
        self.branch(Number(BOOL, self.put(f"icmp slt i64 {now.name}, {size.name}")), inside, end)
        self.begin(inside)
        place = self.put(f"getelementptr inbounds {array.type}, ptr {array.place}, i64 {now.name}")
        self.lines.append(f"store {array.type} {value.name}, ptr {place}")
        self.assign_name("each", Number(WHOLE, self.put(f"add nsw i64 {now.name}, 1")))
        self.go(test)
        self.begin(end)

    # Expressions

    def value(self, node: Any) -> Any:
        match node:
            case ast.Constant(value=int() | float() as value):
                return _constant(value)
            case ast.Name(id=name):
                return self.named(name, node)
            case ast.Tuple(elts=items):
                return Parts(tuple(self.value(item) for item in items))
            case ast.Attribute(value=ast.Name(id="np" | "math"), attr=name):
                return _constant(getattr(math, name))
            case ast.Attribute(value=of, attr="shape"):
                return Parts(self.value(of).shape)
            case ast.Attribute(value=of, attr=name):
                found = self.value(of)
                return found.items[found.names.index(name)]
            case ast.Subscript():
                return self.taken(node)
            case ast.BinOp(left=left, op=op, right=right):
                return self.operated(node, type(op), self.value(left), self.value(right))
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return _constant(-value)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                found = self.value(operand)
                negated = f"fneg double {found.name}"
                negated = negated if found.type == FLOAT else f"sub i64 0, {found.name}"
                return Number(found.type, self.put(negated))
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return self.logic("xor", self.cast(self.value(operand), BOOL), "true")
            case ast.Compare(left=left, ops=ops, comparators=others):
                return self.compared(self.value(left), ops, others)
            case ast.BoolOp(op=op, values=values):
                return self.both(node, isinstance(op, ast.And), values)
            case ast.IfExp(test=test, body=body, orelse=other):
                return self.either(test, body, other)
            case ast.Call(func=of, args=arguments, keywords=[]):
                return self.call(node, of, [self.value(argument) for argument in arguments])
        raise self.refused(node)

    def named(self, name: str, node: Any) -> Any:
        if name in self.types:
            return self.load(name)
        if name in self.names:
            return self.names[name]
        value = self.plain.__globals__.get(name)
        if not isinstance(value, int | float):
            raise self.refused(node)
        return _constant(value)

    def place(self, array: Any, node: Any) -> tuple[Array, str]:
        """Find what is left of an array at a place, and where that is."""
        index = self.value(node)
        places = index.items if isinstance(index, Parts) else (index,)
        fits = isinstance(array, Array) and len(places) <= len(array.shape)
        if not fits or any(k.type != WHOLE or k.name.startswith("-") for k in places):
            raise self.refused(node)
        at = places[0]
        rest = array.shape[len(places) :]
        for other, length in zip(places[1:], array.shape[1:], strict=False):
            at = self.arithmetic(ast.Add, self.arithmetic(ast.Mult, at, length), other)
        for length in rest:
            at = self.arithmetic(ast.Mult, at, length)
        text = f"getelementptr inbounds {array.type}, ptr {array.place}, i64 {at.name}"
        return array._replace(shape=rest), self.put(text)

    def taken(self, node: ast.Subscript) -> Any:
        of = self.value(node.value)
        if isinstance(of, Parts):
            match node.slice:
                case ast.Constant(value=int(k)):
                    return of.items[k]
                case ast.Slice(lower=None, upper=ast.Constant(value=int(k)), step=None):
                    return Parts(of.items[:k])
                case ast.Slice(lower=ast.Constant(value=int(k)), upper=None, step=None):
                    return Parts(of.items[k:])
            raise self.refused(node)
        array, place = self.place(of, node.slice)
        if array.shape:
            return array._replace(place=place)
        return Number(array.type, self.put(f"load {array.type}, ptr {place}"))

    def operated(self, node: Any, op: type, one: Any, two: Any) -> Number:
        """Do what is written: of // the half, the quarter and so on of whole numbers alone."""
        if isinstance(one, Number) and isinstance(two, Number):
            floats = FLOAT in (one.type, two.type)
            halves = two.name.isdigit() and int(two.name).bit_count() == 1
            if op in _WORDS or op is ast.Div or (floats if op is ast.Pow else False):
                return self.arithmetic(op, one, two)
            if op is ast.FloorDiv and halves and not floats:
                return self.arithmetic(op, one, two)
        raise self.refused(node)

    def arithmetic(self, op: type, one: Number, two: Number) -> Number:
        if op is ast.Pow or op is ast.Div:
            one, two = self.cast(one, FLOAT), self.cast(two, FLOAT)
            if op is ast.Pow:
                return self.of_c("llvm.pow.f64", [one, two])
            return Number(FLOAT, self.put(f"fdiv double {one.name}, {two.name}"))
        kind = _widest(one.type, two.type, WHOLE)
        one, two = self.cast(one, kind), self.cast(two, kind)
        if op is ast.FloorDiv:
            return Number(WHOLE, self.put(f"ashr i64 {one.name}, {int(two.name).bit_length() - 1}"))
        word = _WORDS[op]
        word = f"f{word} double" if kind == FLOAT else f"{word} nsw i64"
        return Number(kind, self.put(f"{word} {one.name}, {two.name}"))

    def logic(self, word: str, one: Number, two: str) -> Number:
        return Number(BOOL, self.put(f"{word} i1 {one.name}, {two}"))

    def compared(self, left: Any, ops: list[Any], others: list[Any]) -> Number:
        """A chain of comparisons, also with each of several numbers."""
        found = Number(BOOL, "true")
        for op, node in zip(ops, others, strict=True):
            right, one = self.value(node), Number(BOOL, "false")
            for item in right.items if isinstance(right, Parts) else ():
                one = self.logic("or", one, self.ordered(ast.Eq, left, item).name)
            if isinstance(op, ast.NotIn):
                one = self.logic("xor", one, "true")
            elif not isinstance(op, ast.In):
                one = self.ordered(type(op), left, right)  # pyright: ignore[reportArgumentType]
            found, left = self.logic("and", found, one.name), right
        return found

    def ordered(self, op: type, one: Number, two: Number) -> Number:
        kind = _widest(one.type, two.type, WHOLE)
        one, two, order = self.cast(one, kind), self.cast(two, kind), _ORDERS[op]
        if kind == FLOAT:
            word = f"fcmp {'u' if order == 'ne' else 'o'}{order}"
        else:
            word = f"icmp {'' if order in ('eq', 'ne') else 's'}{order}"
        return Number(BOOL, self.put(f"{word} {kind} {one.name}, {two.name}"))

    def both(self, node: Any, all_of: bool, values: list[Any]) -> Number:
        """Tell whether all, or one, of values are true: as soon as one is known."""
        self.count += 1
        name, end = f"both.{self.count}", self.label()
        for value in values:
            found, further = self.value(value), self.label()
            if found.type != BOOL:  # Python gives one of the numbers
                raise self.refused(node)
            self.assign_name(name, found)
            self.branch(found, *((further, end) if all_of else (end, further)))
            self.begin(further)
        self.begin(end)
        return self.load(name)

    def either(self, test: Any, body: Any, other: Any) -> Any:
        """One of two values, each computed where it is chosen alone."""
        self.count += 1
        name, sizes = f"either.{self.count}", []

        def chosen(node: Any) -> None:
            value = self.value(node)
            items = value.items if isinstance(value, Parts) else (value,)
            sizes.append(len(items) if isinstance(value, Parts) else 0)
            for k, item in enumerate(items):
                self.assign_name(f"{name}.{k}", item)

        self.chosen(test, lambda: chosen(body), lambda: chosen(other))
        found = tuple(self.load(f"{name}.{k}") for k in range(max(1, sizes[0])))
        return Parts(found) if sizes[0] else found[0]

    def call(self, node: Any, of: Any, values: list[Any]) -> Any:
        match of:
            case ast.Attribute(value=ast.Name(id="np" | "math"), attr=name):
                pass
            case ast.Name(id=name):
                plain: Any = self.plain.__globals__.get(name)
                if getattr(plain, "compiled", False):
                    return self.called(plain, values)
                if plain is not None or name in self.types or name in self.names:
                    raise self.refused(node)  # a name that shadows Python's own
            case _:
                raise self.refused(node)
        if name == "len":
            return values[0].shape[0]
        if name == "int" and values[0].type == FLOAT:
            return self.of_c("llvm.fptosi.sat.i64.f64", values, WHOLE)  # 0 of NaN
        if name == "int":
            return self.cast(values[0], WHOLE)
        if name in ("min", "max"):
            return self.extreme(ast.Gt if name == "max" else ast.Lt, values)
        if name == "abs" and values[0].type == WHOLE:
            less = self.ordered(ast.Lt, values[0], Number(WHOLE, "0"))
            negated = self.arithmetic(ast.Sub, Number(WHOLE, "0"), values[0])
            return Number(WHOLE, self.select(less, negated, values[0]))
        values = [self.cast(value, FLOAT) for value in values]
        if name == "isnan":
            return Number(BOOL, self.put(f"fcmp uno double {values[0].name}, 0.0"))
        name = "fabs" if name == "abs" else name
        if name in _INTRINSIC or name == "copysign":
            return self.of_c(f"llvm.{name}.f64", values)
        if name in _OF_C:
            return self.of_c(name, values)
        raise self.refused(node)

    def extreme(self, op: type, values: list[Number]) -> Number:
        kind, values = self.alike(*values)
        found = values[0]
        for value in values[1:]:
            found = Number(kind, self.select(self.ordered(op, value, found), value, found))
        return found

    def select(self, test: Number, yes: Number, no: Number) -> str:
        return self.put(f"select i1 {test.name}, {yes.type} {yes.name}, {no.type} {no.name}")

    def of_c(self, name: str, values: list[Number], kind: str = FLOAT) -> Number:
        """A function of C's library."""
        kinds = ", ".join(FLOAT for _ in values)
        self.unit.declared.add(f"declare {kind} @{name}({kinds}) nounwind willreturn memory(none)")
        listed = ", ".join(f"double {value.name}" for value in values)
        return Number(kind, self.put(f"call {kind} @{name}({listed})"))

    def called(self, plain: Callable, values: list[Any]) -> Any:
        name, kind = self.unit.of(plain, tuple(values))
        listed = ", ".join(f"{of} {at}" for of, at in _flat(values))
        text = f"call {_struct(kind)} @{name}({listed})"
        if kind is None:
            self.lines.append(text)
            return None
        found = self.put(text)
        if isinstance(kind, str):
            return Number(kind, found)
        parts = (self.put(f"extractvalue {_struct(kind)} {found}, {k}") for k in range(len(kind)))
        return Parts(tuple(Number(of, part) for of, part in zip(kind, parts, strict=True)))


def _constant(value: Any) -> Number:
    if isinstance(value, bool):
        return Number(BOOL, str(value).lower())
    if isinstance(value, int):
        return Number(WHOLE, str(value))
    return Number(FLOAT, f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}")


def _is_step(by: list[Number]) -> bool:
    """Tell whether the step of a range, if it has one, is a constant but zero."""
    return not by or (by[0].name.lstrip("-").isdigit() and int(by[0].name) != 0)


def _widest(*kinds: str) -> str:
    return max(kinds, key=_WIDER.__getitem__)


def _struct(kind: Any) -> str:
    """The type of what a function returns, as LLVM writes it."""
    if kind is None:
        return "void"
    return kind if isinstance(kind, str) else "{" + ", ".join(kind) + "}"
