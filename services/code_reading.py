"""Read what the code of a location file declares: a program that runs in a separate process.

`python -m petrobot.services.code_reading` reads one JSON object from standard input, imports each
module that it names, and answers with one line of JSON for each import path. Importing runs code of
the user, which may print, wait, or end the process. So nothing else of petrobot runs in this
process, and `comm.location_file.code`, which starts it, limits its time.

What a function does is read from its source (`ast`), and from all functions and classes of the same
top-level package that it uses. If the source does not show everything, `complete` is false.
"""

from __future__ import annotations

import ast
import builtins
import difflib
import dis
import inspect
import json
import os
import random
import symtable
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, cached_property
from importlib.util import decode_source
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any, get_args, get_type_hints

from msgspec import Struct, field

import petrobot
from petrobot.services import action as actions
from petrobot.services.comm.location_file import MEMORY_CALLS, resolve
from petrobot.services.comm.location_file.code import SLOW
from petrobot.services.device import (
    INTERFACE,
    LIMITS,
    Driver,
    Key,
    Ports,
    Remote,
    faults_of_keys,
    faults_of_limits,
    keys_of,
)
from petrobot.services.host.json_text import json_text
from petrobot.services.host.parent_death import die_with

AWAITED = frozenset(
    ("wait", "sleep", "call", "command", "get", "get_versioned", "put", "compare_and_set")
)
"""Methods of the context that do nothing unless they are awaited."""
AT_ONCE = frozenset(
    name for name, one in vars(actions.Context).items() if inspect.isfunction(one)
).difference(AWAITED)
"""Methods of the context that return at once: to await what they return fails."""
CONTEXT = ("ctx", "context")
"""Usual names of the context."""
PORTS = ("ports", "self.ports", "self._ports")
DEVICE = tuple(f"{name}.device" for name in CONTEXT)
"""The device of an action, as it is usually written."""
REMEMBERS = frozenset(("get", "get_versioned", "put", "compare_and_set"))
"""Calls of the context that need the global memory."""
MADE = {
    actions.success: "success(name=value)",
    actions.failure: 'failure("cause", "text")',
    actions.error: 'error("cause", "text")',
}
"""What makes a result, and how it is written."""
NO_RESULT = (ast.Constant, ast.JoinedStr, ast.Dict, ast.List, ast.Set, ast.Tuple, ast.Compare)
"""What an action may return by mistake, in place of a result."""
API = (actions.__name__, Driver.__module__)
"""Modules of petrobot that define the interface of actions and drivers."""
METHODS = ("period", "state", "stop", "stopped", "hold", "release", "close")
CYCLIC = ("command", "step")
"""Methods that a driver with a period needs in addition to `METHODS`."""
CALLED_IN_CYCLE = ("step", "command", "state", "stop", "stopped", "hold", "release", "quick_stop")
ANSWERS = ("state", "stopped", "hold", "picture")
"""Methods whose answer a node needs."""
_KINDS = {bool: "bool", int: "int", float: "float", str: "str", list: "list", dict: "dict"}


class _Seen(Struct):
    """Findings in the code of one import path."""

    faults: list[tuple[str, int, str]] = field(default_factory=list)
    """Faults, each with file, line and text."""
    doubtful: list[tuple[str, int, str]] = field(default_factory=list)
    """What is probably a fault, in the same form."""
    causes: set[str] = field(default_factory=set)
    """Causes: first arguments of `error`."""
    values: dict[str, dict[str, tuple[str, int]]] = field(default_factory=dict)
    """Names of values of results; by type, as far as it is known, file and line."""
    complete: bool = True
    """Whether the code contains all causes and values as literals."""
    words: set[str] = field(default_factory=set)
    """All texts in the code: a cause that is not a literal may be one of them."""
    streams: dict[str, tuple[str, int]] = field(default_factory=dict)
    events: dict[str, tuple[str, int]] = field(default_factory=dict)
    of_device: dict[str, tuple[str, int]] = field(default_factory=dict)
    """External events, which a driver raises through its ports: not those of an action, although
    its `Context[...]` names the driver."""
    any_event: bool = False
    """Whether it raises events whose names are not literals."""
    calls: dict[str, tuple[str, int]] = field(default_factory=dict)
    """Services that it calls through its context, with file and line."""
    gets: dict[str, tuple[str, int]] = field(default_factory=dict)
    """Variables of the global memory that it reads and for which it gives no default."""
    puts: set[str] = field(default_factory=set)
    any_put: bool = False
    """Whether it may write others, too."""
    lasts: list[tuple[float, str, int, str]] = field(default_factory=list)
    """Constant times (s) for which it sleeps or waits, with file, line and text of the call."""
    reads: dict[str, tuple[str, int]] = field(default_factory=dict)
    """Keys of its device's state that it reads without asking whether they are there, with file and
    line."""
    uses: dict[str, tuple[str, int]] = field(default_factory=dict)
    """Attributes of its device that it uses on every way, with file and line."""
    memory: tuple[str, int] | None = None
    """Where it uses the global memory first."""
    device: tuple[str, int, str] | None = None
    """Where it first uses `ctx.device` or `ctx.command` on every way, not in a branch, and which of
    them."""

    def add(self, other: _Seen) -> None:
        """Add the findings in another function or class. Where one place is kept, the first one
        stays."""
        self.faults += other.faults
        self.doubtful += other.doubtful
        self.lasts += other.lasts
        self.causes |= other.causes
        self.words |= other.words
        self.puts |= other.puts
        self.complete &= other.complete
        self.any_event |= other.any_event
        self.any_put |= other.any_put
        self.memory = self.memory or other.memory
        self.device = self.device or other.device
        for name, kinds in other.values.items():
            own = self.values.setdefault(name, {})
            own |= kinds | own
        for one in ("streams", "events", "of_device", "calls", "gets", "reads", "uses"):
            places: dict[str, tuple[str, int]] = getattr(self, one)
            places |= getattr(other, one) | places


class _Code(Struct, frozen=True, dict=True):
    """The source of one function or class."""

    tree: ast.AST
    file: str
    names: Mapping[str, Any]
    """Values of its global names."""
    bodies: tuple[CodeType, ...]
    """The function, or the methods of the class."""
    found: dict[bool, _Seen] = field(default_factory=dict)
    """The findings in it, by whether an action uses it (`_look`)."""

    @cached_property
    def nodes(self) -> tuple[ast.AST, ...]:
        return tuple(ast.walk(self.tree))

    @cached_property
    def used(self) -> list[Callable[..., Any]]:
        """Functions and classes that it names, without those of the interface."""
        named = (self.value(n) for n in self.nodes if isinstance(n, ast.Name | ast.Attribute))
        return [
            thing
            for thing in named
            if (inspect.isfunction(thing) or inspect.isclass(thing)) and thing.__module__ not in API
        ]

    @cached_property
    def awaited(self) -> set[ast.AST]:
        """Calls that are awaited, or passed on to code that may await them: not operands, and not
        what a result or the context receives as a value."""
        found, values = set[ast.AST](), set[ast.AST]()
        for node in self.nodes:
            if isinstance(node, ast.BinOp | ast.Compare | ast.UnaryOp):
                values |= {*ast.iter_child_nodes(node)}
            elif isinstance(node, ast.Call) and self._takes_values(node):
                values |= {*node.args, *(k.value for k in node.keywords)}
        waits = {n.id for a in self.nodes if isinstance(a, ast.Await) for n in ast.walk(a.value)
                 if isinstance(n, ast.Name) and n not in values}  # fmt: skip
        for node in self.nodes:
            if isinstance(node, ast.Await | ast.Return | ast.Yield):
                found |= set(ast.walk(node))
            elif isinstance(node, ast.Lambda):
                found |= set(ast.walk(node.body))
            elif isinstance(node, ast.Call):
                found |= {*node.args, *(k.value for k in node.keywords)}
            elif isinstance(node, ast.List | ast.Tuple | ast.Set):
                found |= {*node.elts}
            elif isinstance(node, ast.Dict):
                found |= {*node.values}
            elif isinstance(node, ast.DictComp):
                found.add(node.value)
            elif isinstance(node, ast.ListComp | ast.SetComp | ast.GeneratorExp):
                found.add(node.elt)
            elif isinstance(node, ast.Assign) and any(
                isinstance(t, ast.Name) and t.id in waits for t in node.targets
            ):
                found.add(node.value)
        return found - values

    def _takes_values(self, node: ast.Call) -> bool:
        """Whether a call makes a result, or is one of the context that takes plain data."""
        owner, _, name = ast.unparse(node.func).rpartition(".")
        made = self.value(node.func)
        return any(made is one for one in MADE) or (owner in CONTEXT and name != "wait")

    @cached_property
    def kept(self) -> set[ast.AST]:
        """What is assigned to a name that is passed on: it may be awaited there."""
        passed = {n.id for n in self.awaited if isinstance(n, ast.Name)}
        found = set[ast.AST]()
        for node in self.nodes:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                if any(not isinstance(t, ast.Name) or t.id in passed for t in targets):
                    found.add(node.value)
        return found

    @cached_property
    def own(self) -> set[str]:
        """Names that it binds itself, so that they are not the global ones."""
        stored = {
            n.id for n in self.nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
        }
        return stored | {n.arg for n in self.nodes if isinstance(n, ast.arg)}

    @cached_property
    def typed(self) -> dict[str, str]:
        """Types of a function's parameters, as far as it declares them and binds them once."""
        if not isinstance(self.tree, ast.FunctionDef | ast.AsyncFunctionDef):
            return {}
        stored = {n.id for n in self.nodes if isinstance(n, ast.Name) and
                  isinstance(n.ctx, ast.Store)}  # fmt: skip
        given = self.tree.args
        return {
            one.arg: ast.unparse(one.annotation)
            for one in (*given.args, *given.kwonlyargs)
            if one.annotation is not None
            and one.arg not in stored
            and ast.unparse(one.annotation) in _KINDS.values()
        }

    @cached_property
    def branched(self) -> set[ast.AST]:
        """What is in a branch, so that it may never be executed."""
        found = {inner for node in self.nodes if isinstance(node, ast.If | ast.Try | ast.Match)
                 for inner in ast.walk(node)}  # fmt: skip
        return found - self.tested

    @cached_property
    def tested(self) -> set[ast.AST]:
        """What is executed for the question of a branch that is in no branch itself; without
        `and` and `or`, and without what may only be compared with None."""
        found: set[ast.AST] = set()
        for branch in getattr(self.tree, "body", ()):
            inner = [*ast.walk(branch.test)] if isinstance(branch, ast.If) else []
            if not any(isinstance(node, ast.BoolOp | ast.IfExp) for node in inner):
                found |= {node.value for node in inner if isinstance(node, ast.Attribute)}
                found |= {node.func for node in inner if isinstance(node, ast.Call)}
        return found

    @cached_property
    def asks_for_device(self) -> bool:
        """Whether it compares the device of its context with None or asks whether it is there: it
        may then run without one."""
        device = {*DEVICE}
        for node in self.nodes:
            if isinstance(node, ast.Assign) and ast.unparse(node.value) in device:
                device |= {ast.unparse(target) for target in node.targets}
        asked: list[ast.AST] = []
        for node in self.nodes:
            if isinstance(node, ast.Compare) and ast.unparse(node.comparators[0]) == "None":
                asked.append(node.left)
            elif isinstance(node, ast.If | ast.IfExp | ast.While):
                asked.append(node.test)
            elif isinstance(node, ast.BoolOp):
                asked += node.values
            elif isinstance(node, ast.UnaryOp):
                asked.append(node.operand)
        return any(ast.unparse(node) in device for node in asked)

    @cached_property
    def asked(self) -> set[Any]:
        """Constants of which it asks whether something contains them."""
        return {
            node.left.value
            for node in self.nodes
            if isinstance(node, ast.Compare) and isinstance(node.left, ast.Constant)
        }

    @cached_property
    def tried(self) -> set[ast.AST]:
        """What is inside a `try`, so that an exception may be intended."""
        tries = (node for node in self.nodes if isinstance(node, ast.Try))
        return {inner for node in tries for inner in ast.walk(node)}

    def value(self, node: ast.AST) -> Any:
        """Return the object of a dotted name or a constant; None if it is not known."""
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            return None if node.id in self.own else self.names.get(node.id)
        if isinstance(node, ast.Attribute):
            return getattr(self.value(node.value), node.attr, None)
        return None


@cache
def _nodes_of_file(file: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(Path(file).read_bytes())))


@cache
def _functions(file: str) -> Mapping[tuple[str, int], ast.AST]:
    """Return the functions of a file, by name and first line, decorators included."""
    return {
        (node.name, min([node.lineno, *(d.lineno for d in node.decorator_list)])): node
        for node in _nodes_of_file(file)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }


@cache
def _classes(file: str) -> Mapping[str, ast.AST]:
    """Return the classes of a file by qualified name, of several the first one: a class does not
    know its line before Python 3.13."""
    return dict(reversed([*_named_classes(_nodes_of_file(file)[0], "")]))


def _named_classes(owner: ast.AST, prefix: str) -> Iterator[tuple[str, ast.AST]]:
    for node in ast.iter_child_nodes(owner):
        inner = prefix
        if isinstance(node, ast.ClassDef):
            yield prefix + node.name, node
            inner = f"{prefix}{node.name}."
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            inner = f"{prefix}{node.name}.<locals>."
        if not isinstance(node, ast.expr):
            yield from _named_classes(node, inner)


def _code(thing: Callable[..., Any]) -> _Code | None:
    """Return the source of a function or class; None if there is none."""
    if id(thing) not in _read_already:
        # kept with its source: an id may come again, and a class need not be hashable
        _read_already[id(thing)] = thing, _source(thing)
    return _read_already[id(thing)][1]


_read_already: dict[int, tuple[Callable[..., Any], _Code | None]] = {}


def _source(thing: Any) -> _Code | None:
    try:
        thing = inspect.unwrap(thing)
        file = str(inspect.getsourcefile(thing))
        if inspect.isfunction(thing):
            tree = _functions(file)[thing.__name__, thing.__code__.co_firstlineno]
        else:
            tree = _classes(file)[thing.__qualname__]
        names = {**vars(sys.modules[thing.__module__]), **dict(_imported(tree))}
        methods = [thing] if inspect.isfunction(thing) else vars(thing).values()
        codes = [method.__code__ for method in methods if inspect.isfunction(method)]
        written = tuple(code for code in codes if code.co_filename == file)  # not by a decorator
        return _Code(tree, _near(file), names, written)
    except (OSError, TypeError, SyntaxError, KeyError, AttributeError):
        return None


def _near(file: str) -> str:
    """Return a file's path from here, if it is in this folder or below."""
    near = os.path.relpath(file)
    return file if near.startswith("..") else near


def _imported(tree: ast.AST) -> Iterator[tuple[str, Any]]:
    """Yield the names that a function imports in its body, if their modules are loaded already."""
    for node in ast.walk(tree):
        for alias in node.names if isinstance(node, ast.Import | ast.ImportFrom) else ():
            if isinstance(node, ast.Import) and (alias.asname or "." not in alias.name):
                yield alias.asname or alias.name, sys.modules.get(alias.name)
            elif isinstance(node, ast.ImportFrom):
                module = sys.modules.get(node.module or "")
                yield alias.asname or alias.name, getattr(module, alias.name, None)


def _reachable(thing: Any) -> Iterator[_Code]:
    """Yield the source of a function or class, and of everything in its package that it uses,
    directly or indirectly: base classes and helpers."""
    package = str(thing.__module__).partition(".")[0]
    waiting, seen = [thing], set[int]()
    while waiting:
        found = waiting.pop()
        if id(found) in seen or (code := _code(found)) is None:
            continue
        seen.add(id(found))
        yield code
        waiting += (u for u in code.used if str(u.__module__).partition(".")[0] == package)


def _look(code: _Code, in_action: bool) -> _Seen:
    """Return the findings in one function or class. Many actions use the same ones, which are read
    once."""
    if in_action not in code.found:
        seen = code.found[in_action] = _Seen()
        _undefined(code, seen)
        _look_at_nodes(code, seen, in_action)
    return code.found[in_action]


def _commands(node: ast.AST | None) -> bool:
    """Whether it is a `ctx.command(...)`."""
    node = node.value if isinstance(node, ast.Await) else node
    orders = {f"{one}.command" for one in CONTEXT}
    return isinstance(node, ast.Call) and ast.unparse(node.func) in orders


def _receives(node: ast.AST | None) -> bool:
    """Whether it is a `self.ports.stream(...)`."""
    return isinstance(node, ast.Call) and ast.unparse(node.func) in {f"{p}.stream" for p in PORTS}


def _holding(code: _Code, gives: Callable[[ast.AST | None], bool]) -> set[str]:
    """Return the variables that hold nothing but results of such calls."""
    stored = [n for n in code.nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
    given = [
        target.id
        for node in code.nodes
        if isinstance(node, ast.Assign) and gives(node.value)
        for target in node.targets
        if isinstance(target, ast.Name)
    ]
    return {name for name in given if given.count(name) == [n.id for n in stored].count(name)}


def _look_at_nodes(code: _Code, seen: _Seen, in_action: bool) -> None:
    states, streams = _holding(code, _commands), _holding(code, _receives)
    called = {node.func for node in code.nodes if isinstance(node, ast.Call)}
    for node in code.nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            seen.words.add(node.value)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Await):
            _ignored(code, node.value.value, seen)
        if isinstance(node, ast.Attribute) and node.attr in ("device", "command"):
            owner = node.value.id if isinstance(node.value, ast.Name) else ""
            if owner in CONTEXT and not (
                seen.device or node in code.branched or code.asks_for_device
            ):
                seen.device = (code.file, node.lineno, f"{owner}.{node.attr}")
        if isinstance(node, ast.Attribute):
            _misspelt(code, node, seen, in_action)
            # Kept under another name, or of another object: it may raise any event.
            mine = ast.unparse(node.value) in (*CONTEXT, *PORTS) and node in called
            seen.any_event |= node.attr == "raise_event" and not mine
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in DEVICE:
            guarded = node.value in code.branched or node in code.tried or code.asks_for_device
            if isinstance(node.ctx, ast.Load) and not guarded:
                seen.uses.setdefault(node.attr, (code.file, node.lineno))
        if isinstance(node, ast.While) and in_action:
            _loops(code, node, seen)
        if isinstance(node, ast.Await) and isinstance(node.value, ast.Call):
            _awaited_at_once(code, node.value, seen)
        raised = node.exc if isinstance(node, ast.Raise) else None
        if isinstance(raised, ast.Call) and any(code.value(raised.func) is one for one in MADE):
            text = f"`raise {ast.unparse(raised)}`: a result is returned; write `return`"
            seen.faults.append((code.file, raised.lineno, text))
        if isinstance(node, ast.Subscript) and (
            _receives(node.value) or ast.unparse(node.value) in streams
        ):
            text = "is the receiving end of a stream; its numbers, or None, are in"
            name = ast.unparse(node.value)
            seen.faults.append((code.file, node.lineno, f"`{name}` {text} `{name}.values`"))
        if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
            name = str(node.slice.value)
            state = ast.unparse(node.value) in {f"{one}.state" for one in DEVICE} | states
            if state and name not in code.asked and node not in code.tried:
                seen.reads.setdefault(name, (code.file, node.lineno))
        if not isinstance(node, ast.Call):
            continue
        made = code.value(node.func)
        _writes(code, node, made, seen)
        if _commands(node):
            for until in (code.value(k.value) for k in node.keywords if k.arg == "until"):
                if isinstance(until, str) and until and node not in code.tried:
                    seen.reads.setdefault(until, (code.file, node.lineno))
        if any(made is one for one in MADE):  # what it names need not be hashable
            _result(code, node, made, seen)
        elif made is actions.Result:
            seen.complete = False
        elif made is time.sleep and in_action:
            _sleeps(code, node, seen)
        elif in_action and ast.unparse(node.func) == "asyncio.sleep":
            text = "asyncio.sleep does not work in an action; write `await ctx.sleep(...)`"
            seen.doubtful.append((code.file, node.lineno, text))
        elif inspect.iscoroutinefunction(made) and node not in {*code.awaited, *code.kept}:
            _unawaited(code, node, seen)
        elif _draws_unseeded(made, node):
            text = (
                f"{ast.unparse(node.func)} does not use the seed: a run cannot be repeated; "
                'draw from `ctx.random("purpose")`, in a driver `self.ports.random("purpose")`'
            )
            seen.doubtful.append((code.file, node.lineno, text))
        if isinstance(node.func, ast.Attribute):
            _method(code, node, node.func, seen)


def _undefined(code: _Code, seen: _Seen) -> None:
    """Record global names that are defined nowhere: a NameError once that line is executed."""
    for name, line in (found for body in code.bodies for found in _globals(body)):
        if name in code.names or hasattr(builtins, name):
            continue
        if name in _bound(code.file):
            continue
        close = difflib.get_close_matches(name, code.names, n=1)
        remedy = f"; did you mean `{close[0]}`?" if close else "; import it, or define it"
        if hasattr(actions, name):
            remedy = f"; write `from petrobot import {name}`"
        seen.faults.append((code.file, line, f"`{name}` is not defined{remedy}"))
        seen.complete = False  # it may stand for what makes the result


@cache
def _bound(file: str) -> frozenset[str]:
    """Return the global names that a file binds anywhere, also under a condition. What a function
    or class binds is its own, unless it says `global`."""
    top = symtable.symtable(decode_source(Path(file).read_bytes()), file, "exec")
    found = {one.get_name() for one in top.get_symbols() if one.is_local()}
    inner = top.get_children()
    for table in inner:
        inner += table.get_children()
        found |= {one.get_name() for one in table.get_symbols() if one.is_declared_global()}
    return frozenset(found)


def _globals(body: CodeType) -> Iterator[tuple[str, int]]:
    """Yield the global names that a function reads, each with its line, also in functions in it."""
    line = body.co_firstlineno
    for step in dis.get_instructions(body):
        line = (step.positions and step.positions.lineno) or line
        if step.opname == "LOAD_GLOBAL":
            yield step.argval, line
    for inner in body.co_consts:
        if isinstance(inner, CodeType):
            yield from _globals(inner)


def _loops(code: _Code, loop: ast.While, seen: _Seen) -> None:
    """Record a loop of an action that waits, but never gives control away."""
    inner = [node for part in (loop.test, *loop.body) for node in ast.walk(part)]
    clocks = {f"{name}.now" for name in CONTEXT}
    timed = any(ast.unparse(node) in clocks for node in ast.walk(loop.test))
    endless = isinstance(loop.test, ast.Constant) and bool(loop.test.value)
    ways_out = (
        ast.Await | ast.Return | ast.Break | ast.Raise | ast.Yield | ast.AsyncFor | ast.AsyncWith
    )
    if (timed or endless) and not any(isinstance(node, ways_out) for node in inner):
        text = (
            "this loop never ends, as nothing else runs meanwhile, not even the clock; wait in it"
        )
        seen.faults.append((code.file, loop.lineno, f"{text} by `await ctx.sleep(...)`"))


def _misspelt(code: _Code, node: ast.Attribute, seen: _Seen, in_action: bool) -> None:
    """Record a name that the context or a driver's ports lack, if it is close to one that they
    have: something else may be called `context`, too."""
    owner = ast.unparse(node.value)
    kind = Ports if owner == "self.ports" else actions.Context
    known = dir(kind)
    if node.attr in known or (kind is actions.Context and not (in_action and owner in CONTEXT)):
        return
    if close := difflib.get_close_matches(node.attr, known, n=1):
        text = f"`{owner}` has no `{node.attr}`; did you mean `{owner}.{close[0]}`?"
        seen.doubtful.append((code.file, node.lineno, text))


def _unawaited(code: _Code, node: ast.Call, seen: _Seen) -> None:
    name = ast.unparse(node.func)
    text = f"`{name}` does nothing without `await`; write `await {name}(...)`"
    seen.faults.append((code.file, node.lineno, text))


def _awaited_at_once(code: _Code, node: ast.Call, seen: _Seen) -> None:
    """Record an `await` of something that returns at once."""
    owner, _, name = ast.unparse(node.func).rpartition(".")
    made = code.value(node.func)
    if (owner in CONTEXT and name in AT_ONCE) or any(made is one for one in MADE):
        text = f"`await {ast.unparse(node)}`: it returns at once; write it without `await`"
        seen.faults.append((code.file, node.lineno, text))


def _published_late(code: _Code, one: ast.stmt, after: ast.stmt, seen: _Seen) -> None:
    """Record a set point that is published immediately before the run ends."""
    orders = {f"{owner}.publish" for owner in CONTEXT}
    published = isinstance(one, ast.Expr) and isinstance(one.value, ast.Call)
    if not published or ast.unparse(one.value.func) not in orders:  # type: ignore[attr-defined]
        return
    if isinstance(after, ast.Return) and not any(isinstance(n, ast.Await) for n in ast.walk(after)):
        call = ast.unparse(one)
        text = f"`{call}` just before `return` is not sent: a stream ends with its run; "
        text += "write `await ctx.sleep(...)` for a period of the stream between them"
        seen.doubtful.append((code.file, one.lineno, text))


def _draws_unseeded(made: Any, node: ast.Call) -> bool:
    """Return whether a call draws from a generator of the whole process, of `random` or of numpy,
    or makes one without a seed."""
    numpy = sys.modules.get("numpy.random", random)
    kinds = (
        random.Random,
        *(getattr(numpy, name, random.Random) for name in ("RandomState", "Generator")),
    )
    makers = (*kinds, getattr(numpy, "default_rng", random.Random))
    if any(made is one for one in makers):
        return not node.args and not node.keywords
    return isinstance(getattr(made, "__self__", None), kinds)


def _sleeps(code: _Code, node: ast.Call, seen: _Seen) -> None:
    """Record a call of `time.sleep` in an action, or in what an action uses."""
    if isinstance(code.tree, ast.AsyncFunctionDef):
        text = "time.sleep stops everything that runs beside it; write `await ctx.sleep(...)`"
        seen.faults.append((code.file, node.lineno, text))
    else:  # it may stand for a library that blocks
        text = "time.sleep: while it waits, its action can neither be paused nor cancelled"
        seen.doubtful.append((code.file, node.lineno, text))


def _steps(code: _Code, seen: _Seen) -> None:
    """Record calls of `time.sleep` in the methods of a driver that its cycle calls."""
    for method in getattr(code.tree, "body", ()):
        if isinstance(method, ast.FunctionDef) and method.name in CALLED_IN_CYCLE:
            for node in ast.walk(method):
                if isinstance(node, ast.Call) and code.value(node.func) is time.sleep:
                    text = f"time.sleep in `{method.name}`: the driver misses its cycles meanwhile"
                    seen.doubtful.append((code.file, node.lineno, text))


def _ignored(code: _Code, awaited: ast.expr, seen: _Seen) -> None:
    """Record a call of a service whose result is dropped."""
    if isinstance(awaited, ast.Call) and ast.unparse(awaited.func) in ("ctx.call", "context.call"):
        text = (
            "the result of `ctx.call` is dropped, so a failure would go unnoticed; test its "
            "`status`, and for the memory write `ctx.put`"
        )
        seen.doubtful.append((code.file, awaited.lineno, text))


def _method(code: _Code, node: ast.Call, function: ast.Attribute, seen: _Seen) -> None:
    """Record a call of a method of the context, or of a driver's ports."""
    owner, name = ast.unparse(function.value), function.attr
    first = code.value(node.args[0]) if node.args else None
    ports = owner in PORTS
    if owner in CONTEXT or ports:
        if name == "call":
            seen.complete = False
        if name in AWAITED and not ports and node not in code.awaited:
            _unawaited(code, node, seen)
        if not ports:
            _binds(code, node, vars(actions.Context).get(name), seen.faults)
        if name in REMEMBERS and not ports:
            seen.memory = seen.memory or (code.file, node.lineno)
            _remembers(code, node, name, first, seen)
        if name in ("sleep", "wait") and not ports:
            _lasts(code, node, name, seen)
        if name == "raise_event" and not isinstance(first, str):
            seen.any_event = True
        if isinstance(first, str):
            if name in ("publish", "withdraw", "stream"):
                _set_points(code, node, seen)
                seen.streams.setdefault(first, (code.file, node.lineno))
            elif name == "raise_event":
                events = seen.of_device if ports else seen.events
                events.setdefault(first, (code.file, node.lineno))
            elif name == "call" and not ports:
                seen.calls.setdefault(first, (code.file, node.lineno))


def _binds(code: _Code, node: ast.Call, method: object, faults: list[tuple[str, int, str]]) -> None:
    """Record a call of a method of the context, or of its device, with wrong arguments."""
    starred = any(isinstance(one, ast.Starred) for one in node.args)
    if not inspect.isfunction(method) or starred or any(k.arg is None for k in node.keywords):
        return
    try:
        inspect.signature(method).bind(
            None, *node.args, **{str(k.arg): None for k in node.keywords}
        )
    except TypeError as fault:
        takes = (
            str(inspect.signature(method))
            .partition(" ->")[0]
            .replace("(self, ", "(")
            .replace("(self)", "()")
        )
        text = f"`{ast.unparse(node)}`: {fault}; it is `{ast.unparse(node.func)}{takes}`"
        faults.append((code.file, node.lineno, text))


def _set_points(code: _Code, node: ast.Call, seen: _Seen) -> None:
    """Record set points that are certainly not a list."""
    given = [*node.args[1:2], *(k.value for k in node.keywords if k.arg == "values")]
    if any(_kind(code, value) not in ("", "list") for value in given):
        call = f"{ast.unparse(node.func)}({ast.unparse(node.args[0])}"
        text = f"`{ast.unparse(node)}`: set points are a list of numbers; write `{call}, [...])`"
        seen.faults.append((code.file, node.lineno, text))


def _remembers(code: _Code, node: ast.Call, name: str, first: Any, seen: _Seen) -> None:
    """Record a variable of the global memory that a call reads without a default."""
    if name == "get" and isinstance(first, str) and len(node.args) == 1 and not node.keywords:
        seen.gets.setdefault(first, (code.file, node.lineno))


def _writes(code: _Code, node: ast.Call, made: Any, seen: _Seen) -> None:
    """Record what a call may write into the global memory: also through another object than the
    context. Code that receives the context and is not read may write, or raise, anything."""
    if isinstance(node.func, ast.Attribute) and node.func.attr in ("put", "compare_and_set"):
        name = code.value(node.args[0]) if node.args else None
        seen.any_put |= not isinstance(name, str)
        seen.puts |= {name} if isinstance(name, str) else set()
    elif isinstance(node.func, ast.Attribute) and node.func.attr == "call":
        seen.any_put |= (code.value(node.args[0]) if node.args else None) in (None, *MEMORY_CALLS)
    given = [*node.args, *(keyword.value for keyword in node.keywords)]
    if any(ast.unparse(one).rpartition(".")[2] in CONTEXT for one in given):
        own = str(code.names.get("__name__")).partition(".")[0]
        unread = str(getattr(made, "__module__", "")).partition(".")[0] != own
        seen.any_put |= unread
        seen.any_event |= unread


def _lasts(code: _Code, node: ast.Call, name: str, seen: _Seen) -> None:
    """Record for how long (s) a call sleeps or waits, if that is a constant."""
    at, key = (0, "seconds") if name == "sleep" else (1, "timeout")
    given = [*node.args[at : at + 1], *(k.value for k in node.keywords if k.arg == key)]
    seconds = code.value(given[0]) if given else None
    if isinstance(code.tree, ast.ClassDef):
        return  # each method may be used by another action
    if isinstance(seconds, int | float) and not isinstance(seconds, bool):
        seen.lasts.append((float(seconds), code.file, node.lineno, ast.unparse(node.func)))


def _result(code: _Code, node: ast.Call, made: Callable[..., Any], seen: _Seen) -> None:
    """Record cause and values of `success(...)`, `failure(...)` or `error(...)`."""
    keywords = {k.arg: None for k in node.keywords if k.arg is not None}
    if len(keywords) == len(node.keywords) and not any(
        isinstance(a, ast.Starred) for a in node.args
    ):
        try:
            inspect.signature(made).bind(*node.args, **keywords)
        except TypeError as fault:
            text = f"`{ast.unparse(node)}`: {fault}; write `{MADE[made]}`"
            seen.faults.append((code.file, node.lineno, text))
        for shown in node.args[:1] if made is actions.success else ():
            if (kind := _kind(code, shown)) not in ("", "str"):
                words = f"`{ast.unparse(node)}`: its text is of type {kind}; write `{MADE[made]}`"
                seen.faults.append((code.file, node.lineno, words))
    for keyword in node.keywords:
        if keyword.arg is None:
            seen.complete = False
        elif keyword.arg not in ("cause", "text") or made is actions.success:
            kinds = seen.values.setdefault(keyword.arg, {})
            if kind := _kind(code, keyword.value):
                kinds.setdefault(kind, (code.file, keyword.value.lineno))
    if made is not actions.error:
        return
    given = [*node.args[:1], *(k.value for k in node.keywords if k.arg == "cause")]
    parts = [part for cause in given for part in _branches(cause)]
    for cause in (code.value(part) for part in parts):
        if isinstance(cause, str):
            seen.causes.add(str(cause))
        else:
            seen.complete = False


def _kind(code: _Code, node: ast.expr) -> str:
    """Return the type of an expression's value; empty if its form does not show it."""
    match node:
        case ast.Name(id=name):
            return code.typed.get(name, "")
        case ast.Constant():
            return _KINDS.get(type(node.value), "")
        case ast.UnaryOp(op=ast.USub(), operand=positive):
            return _kind(code, positive)
        case ast.JoinedStr():
            return "str"
        case ast.List() | ast.ListComp():
            return "list"
        case ast.Dict() | ast.DictComp():
            return "dict"
        case ast.Call(func=ast.Name(id=name)) if name not in code.own and name not in code.names:
            return name if name in _KINDS.values() else ""
    return ""


def _branches(node: ast.expr) -> Iterator[ast.expr]:
    """Return the possible values of an expression: its branches if it is a choice."""
    if isinstance(node, ast.IfExp):
        yield from _branches(node.body)
        yield from _branches(node.orelse)
    else:
        yield node


# --------------------------------------------------------------------------- functions and drivers


def _function(thing: Callable[..., Any]) -> dict[str, Any]:
    """Return the findings on an action or service."""
    try:
        parameters = list(inspect.signature(thing).parameters.values())
    except (TypeError, ValueError):
        return {}
    try:
        hints = get_type_hints(thing)
    except Exception:
        hints = {}
    first = parameters[0] if parameters else None
    alone = first is None or first.kind is first.KEYWORD_ONLY or hints.get(first.name) in _KINDS
    own_names = parameters if alone else parameters[1:]
    named = [p for p in own_names if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    seen = _Seen()
    is_async = inspect.iscoroutinefunction(thing)
    if inspect.isfunction(inspect.unwrap(thing)):
        seen.any_put = inspect.unwrap(thing) is not thing or _code(thing) is None
        for code in _reachable(inspect.unwrap(thing)):
            seen.add(_look(code, is_async))
    else:
        seen.complete, seen.any_put = False, True
    own = _code(thing) if inspect.isfunction(thing) else None
    if own is not None:
        if inspect.isgeneratorfunction(thing) or inspect.isasyncgenfunction(thing):
            made = next(n for n in own.nodes if isinstance(n, ast.Yield | ast.YieldFrom))
            text = f"`yield` makes {thing.__name__} a generator, which does nothing"
            text += "; report progress by `ctx.progress(...)`, and return one result"
            seen.faults.append((own.file, made.lineno, text))
        _ends(own, thing.__name__, seen)
        _asks_device(own, _driver_of(hints.get(first.name) if first else None), seen)
    if alone:
        source = inspect.unwrap(thing).__code__
        text = f"{thing.__name__} takes no context; its first parameter is `ctx`"
        text += f", found {first.name!r}" if first else ""
        # That its body finds no `ctx` follows from it.
        seen.faults = [one for one in seen.faults if not one[2].startswith("`ctx` is not")]
        seen.faults.append((_near(source.co_filename), source.co_firstlineno, text))
    return {
        "parameters": {p.name: _KINDS.get(hints.get(p.name, object), "") for p in named},
        "required": [p.name for p in named if p.default is p.empty],
        "open": any(p.kind is p.VAR_KEYWORD for p in parameters),
        "wants": _wanted(hints.get(first.name) if first else None),
        **_plain(seen),
    }


def _asks_device(own: _Code, driver: type[Driver] | None, seen: _Seen) -> None:
    """Record calls of methods of an action's device with wrong arguments. The device of a cyclic
    driver is its remote."""
    if driver is None or driver.period is not None:
        return
    for node in own.nodes:
        match node:
            case ast.Call(func=ast.Attribute(value=owner, attr=name)):
                if ast.unparse(owner) in DEVICE:
                    method = inspect.getattr_static(driver, name, None)
                    _binds(own, node, method, seen.doubtful)


def _ends(own: _Code, name: str, seen: _Seen) -> None:
    """Record where a function certainly ends without a result."""
    if _falls_off(last := own.tree.body[-1]):  # type: ignore[attr-defined]
        text = f"{name} returns no result here; end it with `return success()`"
        seen.faults.append((own.file, last.end_lineno, text))
    for value in _returned(own.tree):
        if isinstance(value, NO_RESULT) or any(own.value(value) is one for one in MADE):
            text = f"`return {ast.unparse(value)}` is not a result; write `return success()`"
            seen.faults.append((own.file, value.lineno, text))
        for part in _branches(value) if isinstance(own.tree, ast.AsyncFunctionDef) else ():
            if isinstance(part, ast.Call):
                _unawaited_result(own, part, seen)
    for body in (getattr(n, part, ()) for n in own.nodes for part in ("body", "orelse")):
        for one, after in pairwise(body if isinstance(body, list) else ()):
            _published_late(own, one, after, seen)


def _unawaited_result(own: _Code, call: ast.Call, seen: _Seen) -> None:
    """Record a result that an action returns without awaiting it."""
    owner, _, method = (name := ast.unparse(call.func)).rpartition(".")
    called = f"{owner}.call" == name and owner in CONTEXT
    if owner in CONTEXT and method in AWAITED and not called:
        text = f"`return {ast.unparse(call)}` is not a result; write `return success()` after it"
    elif called or inspect.iscoroutinefunction(own.value(call.func)):
        text = (
            f"`return {name}(...)` without `await` does nothing; write `return await {name}(...)`"
        )
    else:
        return
    seen.faults.append((own.file, call.lineno, text))


def _returned(function: ast.AST) -> Iterator[ast.expr]:
    """Return what a function returns, without the functions inside it."""
    for node in ast.iter_child_nodes(function):
        if isinstance(node, ast.Return) and node.value is not None:
            yield node.value
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _returned(node)


def _falls_off(last: ast.stmt) -> bool:
    """Return whether a function certainly ends without a result after its last statement. What it
    awaits may last until it is cancelled."""
    if isinstance(last, ast.Expr) and isinstance(last.value, ast.Await):
        call = last.value.value
        name = ast.unparse(call.func) if isinstance(call, ast.Call) else ""
        owner, _, method = name.rpartition(".")
        return owner in CONTEXT and method in AWAITED - {"wait"}
    return isinstance(last, ast.Expr | ast.Assign | ast.AugAssign | ast.AnnAssign | ast.Pass)


def _driver_of(hint: Any) -> type[Driver] | None:
    """Return the class of the driver that an action's `Context[...]` names; None if it names
    none."""
    found = next(iter(get_args(hint)), None)
    named = inspect.isclass(found) and issubclass(found, Driver) and found is not Driver
    return found if named else None


def _wanted(hint: Any) -> list[str]:
    """Return the name of that class, and its path; empty if there is none."""
    found = _driver_of(hint)
    return [found.__name__, f"{found.__module__}:{found.__qualname__}"] if found else []


def _driver(thing: Any, tables: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the findings on a driver's class, and by device the faults of the keys of its
    table."""
    seen = _Seen()
    if not inspect.isclass(thing):
        name = getattr(thing, "__name__", "it")
        text = f"{name!r} is not a class; a driver is a class derived from `Driver`"
        return {"keys": {device: [["driver", text]] for device in tables}}
    for code in _reachable(thing):
        seen.add(_look(code, in_action=False))
        if issubclass(thing, Driver) and thing.period is not None:
            _steps(code, seen)
    if issubclass(thing, Driver):
        _methods(thing, seen)
    period, own = getattr(thing, "period", None), _code(thing)
    if isinstance(period, int | float) and period > SLOW and own is not None:
        text = f"{thing.__name__}.period is {period:g} s between two steps; 0.01 would be 10 ms"
        seen.doubtful.append((own.file, own.tree.lineno, text))  # type: ignore[attr-defined]
    found = {device: _faults_of_driver(thing, **table) for device, table in tables.items()}
    dry = {"dry_run": True} if issubclass(thing, Driver) else {}
    moves = True if seen.streams else None  # set points may move a device without commands
    return {
        "keys": found,
        "dry_run": not faults_of_limits(thing, dry, moves),
        "classes": [f"{base.__module__}:{base.__qualname__}" for base in thing.__mro__],
        "state": _state(thing),
        "members": _members(thing),
        **_plain(seen),
        "events": seen.of_device | seen.events,
    }


def _state(thing: type) -> list[str] | None:
    """Return the keys of a cyclic driver's state; None if its source does not show them."""
    if getattr(thing, "period", None) is None or not hasattr(thing, "state"):
        return None
    names = _state_of(thing.__mro__)
    return None if names is None else sorted(names)


def _state_of(classes: Sequence[type]) -> set[str] | None:
    """Return the keys that `state` of the first class that has it returns; `super().state()` in it
    is that of the classes after it."""
    at = next((n for n, one in enumerate(classes) if "state" in vars(one)), len(classes))
    method = vars(classes[at])["state"] if at < len(classes) else None
    code = _code(method) if inspect.isfunction(method) else None
    parts = [node.value for node in code.nodes if isinstance(node, ast.Return)] if code else []
    names = set[str]()
    if not parts:
        return None
    while parts:
        match parts.pop():
            case ast.BinOp(op=ast.BitOr(), left=left, right=right):
                parts += [left, right]
            case ast.Dict(keys=keys, values=values):
                parts += [v for k, v in zip(keys, values, strict=True) if k is None]
                words = [k.value for k in keys if isinstance(k, ast.Constant)]
                if len(words) < len([k for k in keys if k is not None]):
                    return None
                names |= set(map(str, words))
            case other:
                if other is None or ast.unparse(other) != "super().state()":
                    return None
                if (inherited := _state_of(classes[at + 1 :])) is None:
                    return None
                names |= inherited
    return names


def _members(thing: type) -> list[str] | None:
    """Return the attributes that an action finds at its device: those of the remote if the driver
    is cyclic; None if the source does not show them."""
    if getattr(thing, "period", None) is not None:
        return [name for name in vars(Remote) if not name.startswith("_")]
    return None if _sets_period(thing) else _own_names(thing)


def _own_names(thing: type) -> list[str] | None:
    """Return the attributes of a driver; None if the source does not show them."""
    codes = [_code(base) for base in thing.__mro__ if base not in (object, Driver)]
    nodes = [node for code in codes if code is not None for node in code.nodes]
    words = {node.id for node in nodes if isinstance(node, ast.Name)}
    if None in codes or hasattr(thing, "__getattr__") or words & {"setattr", "vars"}:
        return None
    stored = {
        n.attr for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)
    }
    declared = {name for base in thing.__mro__ for name in inspect.get_annotations(base)}
    return sorted(stored | declared | {*dir(thing), *keys_of(thing), *LIMITS, "ports"})


def _methods(thing: type[Driver], seen: _Seen) -> None:
    """Record methods of a driver that answer nothing, and those that its node never calls because
    of their names."""
    for base in thing.__mro__[: thing.__mro__.index(Driver)]:
        for name, method in vars(base).items():
            used = inspect.isfunction(method) and getattr(thing, name) is method
            if used and (code := _code(method)) is not None:
                _unset_names(thing, code, seen)
                line = code.tree.lineno  # type: ignore[attr-defined]
                what = f"`{name}` of {base.__name__}"
                if text := _fault_of_method(name, code):
                    seen.faults.append((code.file, line, f"{what} {text}"))
                elif near := _meant(thing, name):
                    text = f"{what} is never called; did you mean `{near}`?"
                    seen.doubtful.append((code.file, line, text))


def _unset_names(thing: type[Driver], code: _Code, seen: _Seen) -> None:
    """Record what a method reads of its driver and nothing sets, if it is close to a name that is
    there."""
    known = _own_names(thing)
    for node in code.nodes if known is not None else ():
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "self":
            close = difflib.get_close_matches(node.attr, known or (), n=1)
            if node.attr not in (known or ()) and close and node not in code.tried:
                text = f"`self.{node.attr}` is set nowhere; did you mean `self.{close[0]}`?"
                seen.doubtful.append((code.file, node.lineno, text))


def _fault_of_method(name: str, code: _Code) -> str:
    """Return why a node cannot use a method of its driver's interface; empty if it can."""
    if name not in INTERFACE:
        return ""
    answers = any(
        isinstance(node, ast.Return | ast.Yield) and node.value is not None for node in code.nodes
    )
    if name in ANSWERS and not answers and not any(isinstance(n, ast.Raise) for n in code.nodes):
        return "returns nothing; write `return` before its answer"
    returned = [node.value for node in code.nodes if isinstance(node, ast.Return)]
    parts = [part for value in returned if isinstance(value, ast.Dict) for part in value.values]
    if name == "state" and any(isinstance(part, ast.Set | ast.SetComp) for part in parts):
        return "contains a set, which is not plain data; write a list"
    return ""


def _meant(thing: type[Driver], name: str) -> str:
    """Return which method of the interface a name of a cyclic driver's method probably means: one
    that the driver lacks, while its own code never uses the name."""
    if thing.period is None or name in INTERFACE or name.startswith("_"):
        return ""
    lacks = [n for n, usual in INTERFACE.items() if getattr(thing, n, usual) is usual]
    close = difflib.get_close_matches(name, lacks, n=1, cutoff=0.8)
    used = close and any(
        isinstance(node, ast.Attribute) and node.attr == name
        for code in _reachable(thing)
        for node in code.nodes
    )
    return close[0] if close and not used else ""


def _faults_of_driver(
    thing: type, table: Mapping[str, Any], follows: bool
) -> list[tuple[str, str]]:
    """Return the faults of a driver's class and of the keys of a device's table. `follows`: a
    stream of set points leads to the device."""
    keys: list[tuple[str, str]] = []
    period: Any = getattr(thing, "period", None)
    if isinstance(period, Key):
        period = table.get("period", period.default)
    declared = not hasattr(period, "__get__")  # a property is known only when the driver is made
    moves = declared and period is not None
    wanted = [*METHODS, *(CYCLIC if moves else ())]
    if missing := [name for name in wanted if not hasattr(thing, name)]:
        text = f"{thing.__name__} has no {', '.join(missing)}; derive it from petrobot.Driver"
        keys.append(("driver", text))
    is_number = isinstance(period, int | float) and not isinstance(period, bool)
    if moves and not (is_number and 0.0 < period < float("inf")):
        text = f"{thing.__name__}.period: expected seconds above 0 or None, found {period!r:.40}"
        keys.append(("driver", text))
    own = [n for n in CYCLIC if getattr(thing, n, None) not in (None, getattr(Driver, n))]
    if declared and period is None and own and not _sets_period(thing):
        text = f"{thing.__name__} has `{own[-1]}` and no period: it is never called; write "
        keys.append(("driver", f"{text}`period = 0.01` (s between two steps) in the class"))
    if unset := _unset(thing):
        text = f"the constructor of {thing.__name__} does not call the one of Driver, so that "
        text += f"{', '.join(unset)} would not be set; write `super().__init__(config, ports)`"
        keys.append(("driver", f"{text}, or write `setup` instead"))
    check = faults_of_keys if issubclass(thing, Driver) else faults_of_limits
    return [*keys, *check(thing, table, follows or None)]


def _unset(thing: type) -> list[str]:
    """Return what a constructor of its own leaves unset, of all that the driver uses."""
    maker = next(base for base in thing.__mro__ if "__init__" in vars(base))
    if not issubclass(thing, Driver) or maker.__module__.startswith(f"{petrobot.__name__}."):
        return []
    nodes = [node for code in _reachable(thing) for node in code.nodes]
    own = [n for n in nodes if isinstance(n, ast.Attribute) and ast.unparse(n.value) == "self"]
    if any(isinstance(n, ast.Attribute) and n.attr in ("__init__", "limit") for n in nodes):
        return []
    stored = {n.attr for n in own if isinstance(n.ctx, ast.Store)}
    wanted = [*keys_of(thing), *(n for n in LIMITS if n in thing.obeys)]
    wanted += ["ports"] if any(n.attr == "ports" for n in own) else []
    return [name for name in wanted if name not in stored]


def _sets_period(thing: type) -> bool:
    """Return whether a driver's code assigns its period, as one that reads it from a file does."""
    return any(
        isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store)
        and node.attr == "period"
        for code in _reachable(thing)
        for node in code.nodes
    )


def _plain(seen: _Seen) -> dict[str, Any]:
    return {
        "faults": sorted(set(seen.faults)),
        "doubtful": sorted(set(seen.doubtful)),
        "causes": sorted(seen.causes),
        "values": seen.values,
        "complete": seen.complete,
        "words": sorted(w for w in seen.words if len(w) <= 100 and w.isidentifier()),
        "streams": seen.streams,
        "events": seen.events,
        "any_event": seen.any_event,
        "calls": seen.calls,
        "gets": seen.gets,
        "puts": sorted(seen.puts),
        "any_put": seen.any_put,
        "lasts": seen.lasts,
        "reads": seen.reads,
        "uses": seen.uses,
        "memory": seen.memory,
        "device": seen.device,
    }


def _read(path: str, tables: Mapping[str, Any] | None) -> dict[str, Any]:
    """Import one path and return the findings: `classes` says that it is a class."""
    try:
        thing = resolve(path)
    except ImportError as fault:
        return {"import": str(fault)}
    if tables is None and inspect.isclass(thing):
        return {"classes": []}
    return _function(thing) if tables is None else _driver(thing, tables)


def main() -> None:
    """Answer on the original standard output; output of imported code is dropped."""
    asked = json.load(sys.stdin)
    die_with(asked["parent"])
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    sys.path[:] = asked["sys_path"]
    for path, tables in asked["paths"]:
        answers.write(json_text({"path": path, **_read(path, tables)}) + "\n")
        answers.flush()
    answers.close()
    os._exit(0)  # threads and exit handlers of imported modules must not delay the end


if __name__ == "__main__":
    main()
