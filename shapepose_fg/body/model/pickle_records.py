"""Undoes a pickle into plain values and records, within bounds and without running anything that it names.

A pickle is a program for a small machine: loading one from the internet can do whatever Python can, a few bytes of
it fill the memory or crash the interpreter, and what one program did to a class is still there for the next. So
Python's own machine does not run here. This one knows the instructions that arrays need (`pickletools` has their
encodings); it looks up no name, and calls nothing: a name is a name, and an object is a `Record` of what the
file says about it.
"""

import codecs
import io
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO

_MOST_STEPS = 2_000_000
"""SMPL's files take a few thousand."""
_OPCODES = {each.code: each for each in pickletools.opcodes}
_REBUILDS = {("copy_reg", "_reconstructor"), ("copyreg", "_reconstructor")}
"""Functions that make an object of the class that is their first argument."""


class RefusedPickle(Exception):
    """The pickle asks for something that a body model does not need."""


@dataclass(frozen=True)
class Name:
    """A class or function that the pickle names; nothing of that kind is ever looked up."""

    module: str
    name: str


class Record:
    """What the pickle says of one object: which name was called with which arguments, and its state."""

    def __init__(self, name: Name, arguments: tuple[Any, ...]):
        self.name = name
        self.arguments = arguments
        self.state: Any = None


def read_records(content: bytes, known: Callable[[Name], bool]) -> Any:
    """The value that a pickle stands for, with a `Record` for every object; memory is in proportion to `content`.

    Text of Python 2 is read as Latin-1. RefusedPickle where a name is not `known`, or the pickle does what no
    writer of arrays does; other exceptions where it is damaged.
    """
    return _Machine(known).run(io.BytesIO(content))


class _Machine:
    """Stack and memory of one pickle."""

    def __init__(self, known: Callable[[Name], bool]):
        self.known = known
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memory: dict[int, Any] = {}

    def run(self, stream: BinaryIO) -> Any:
        for _ in range(_MOST_STEPS):
            code = stream.read(1)
            opcode = _OPCODES.get(code.decode("latin1"))
            if opcode is None:
                raise ValueError("the pickle ends too early" if code == b"" else f"{code!r} is no instruction")
            argument = _argument(opcode, stream)
            if opcode.name == "STOP":
                return self.pop()
            self.step(opcode.name, argument)
        raise RefusedPickle(f"it takes over {_MOST_STEPS} steps, and a body model a few thousand")

    def step(self, name: str, argument: Any) -> None:
        """One instruction."""
        if name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name]())
        elif name in _VALUES:
            self.stack.append(argument)
        elif name in _TUPLES:
            self.stack.append(tuple(self.pop() for _ in range(_TUPLES[name]))[::-1])
        elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            self.memory[len(self.memory) if name == "MEMOIZE" else argument] = self.stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            self.stack.append(self.memory[argument])
        elif name not in _STEPS:
            raise RefusedPickle(f"it has the instruction {name}, which no array needs")
        else:
            _STEPS[name](self, argument)

    def pop(self) -> Any:
        """The last value that is not behind a mark."""
        if len(self.stack) <= (self.marks[-1] if self.marks else 0):
            raise ValueError("the pickle takes a value that is not there")
        return self.stack.pop()

    def pop_marked(self) -> list[Any]:
        """All values since the last mark."""
        start = self.marks.pop()
        values = self.stack[start:]
        del self.stack[start:]
        return values

    def into_list(self, values: list[Any]) -> None:
        self.top(list).extend(values)

    def into_dict(self, values: list[Any]) -> None:
        if len(values) % 2 or not all(isinstance(key, str | int) for key in values[::2]):
            raise RefusedPickle("it has keys that are no text")
        self.top(dict).update(zip(values[::2], values[1::2], strict=True))

    def top(self, kind: type) -> Any:
        """The last value, which must be of that kind."""
        if not isinstance(self.stack[-1], kind):
            raise RefusedPickle(f"it fills a {type(self.stack[-1]).__name__} as a {kind.__name__}")
        return self.stack[-1]

    def name(self, module: Any, name: Any) -> None:
        found = Name(str(module), str(name))
        if found not in _REBUILT_NAMES and not self.known(found):
            raise RefusedPickle(f"it asks for {found.module}.{found.name}, which no body model needs")
        self.stack.append(found)

    def call(self) -> None:
        arguments, made = self.pop(), self.pop()
        if isinstance(made, Name) and (made.module, made.name) in _REBUILDS and isinstance(arguments, tuple):
            made, arguments = (arguments[0] if arguments else None), ()
        if not isinstance(made, Name) or made in _REBUILT_NAMES or not isinstance(arguments, tuple):
            raise RefusedPickle("it makes an object of something that is not an array")
        self.stack.append(Record(made, arguments))

    def build(self) -> None:
        state = self.pop()
        self.top(Record).state = state

    def named_on_stack(self) -> None:
        name, module = self.pop(), self.pop()
        self.name(module, name)


def _argument(opcode: pickletools.OpcodeInfo, stream: BinaryIO) -> Any:
    if opcode.arg is None:
        return None
    if opcode.name == "STRING":  # pickletools knows ASCII only; Python 2 wrote arrays so
        line = stream.readline()
        if not line.endswith(b"\n") or len(line.strip()) < 2:
            raise ValueError("the pickle ends too early")
        return codecs.escape_decode(line.strip()[1:-1])[0].decode("latin1")  # type: ignore[attr-defined]
    return opcode.arg.reader(stream)  # type: ignore[misc]


_REBUILT_NAMES = {Name(*each) for each in _REBUILDS}
_CONSTANTS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
    "EMPTY_TUPLE": tuple,
}
_VALUES = frozenset(
    "INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING UNICODE"
    " BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8".split()
)
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_STEPS: dict[str, Callable[[_Machine, Any], None]] = {
    "PROTO": lambda machine, _: None,
    "FRAME": lambda machine, _: None,
    "MARK": lambda machine, _: machine.marks.append(len(machine.stack)),
    "POP": lambda machine, _: machine.pop() and None,
    "LIST": lambda machine, _: machine.stack.append(machine.pop_marked()),
    "TUPLE": lambda machine, _: machine.stack.append(tuple(machine.pop_marked())),
    "DICT": lambda machine, _: _dict(machine),
    "APPEND": lambda machine, _: machine.into_list([machine.pop()]),
    "APPENDS": lambda machine, _: machine.into_list(machine.pop_marked()),
    "SETITEM": lambda machine, _: machine.into_dict([machine.pop() for _ in range(2)][::-1]),
    "SETITEMS": lambda machine, _: machine.into_dict(machine.pop_marked()),
    "GLOBAL": lambda machine, argument: machine.name(*argument.split(" ", 1)),
    "STACK_GLOBAL": lambda machine, _: machine.named_on_stack(),
    "REDUCE": lambda machine, _: machine.call(),
    "NEWOBJ": lambda machine, _: machine.call(),
    "BUILD": lambda machine, _: machine.build(),
}


def _dict(machine: _Machine) -> None:
    values = machine.pop_marked()
    machine.stack.append({})
    machine.into_dict(values)
