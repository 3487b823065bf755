"""An interpreter for a subset of URScript, from one control cycle to the next.

It knows functions and threads without parameters, `global`, assignments, `if`, `while`, `run`, `kill` and calls, and
is strict: what a controller would refuse to compile, or would stop the program for, raises `UrscriptError`.
Expressions of the subset are expressions of Python as well, and are parsed as such.
"""

import ast
import functools
import inspect
import itertools
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn

MAX_STATEMENTS = 1000  # of a thread in one cycle: a controller stops a program that never waits
NAME = r"[A-Za-z_]\w*"
NUMBERS = (int, float)
ARITHMETIC = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul}
ORDER = {ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge}
EQUALITY = {ast.Eq: operator.eq, ast.NotEq: operator.ne}


class UrscriptError(Exception):
    """What the controller shows at the pendant when a program is wrong."""


class Pose(tuple[float, ...]):
    """Six numbers, m and rad: a type of its own in URScript."""

    __slots__ = ()


@dataclass
class Statement:
    """A line with what is nested in it."""

    line: int
    text: str
    block: list["Statement"] = field(default_factory=list)
    branches: list["Statement"] = field(default_factory=list)  # of an `if`: its `elif` and `else`


Function = Callable[..., Any]


class Program:
    """A program and its state.

    `threads` holds the main thread and those that `run` has started; a step of each is a control cycle.
    """

    def __init__(self, text: str, functions: Mapping[str, Function], motions: Mapping[str, Function]) -> None:
        """Compile a program; UrscriptError if it is not of the subset, or calls what there is not.

        Args:
            text: the program.
            functions: what answers at once, by name.
            motions: what takes time, by name: generators, which yield once a cycle.
        """
        self._functions, self._motions = functions, motions
        self._globals: dict[str, Any] = {}
        self._bodies: dict[str, Statement] = {}  # functions and threads, by name
        lines = [(i, re.sub(r"#.*", "", line).strip()) for i, line in enumerate(text.splitlines(), 1)]
        statements = _parse_block(iter([line for line in lines if line[1]]), Statement(0, ""), nested=False)
        if len(statements) != 1 or not statements[0].text.startswith("def "):
            raise UrscriptError("a program is one function")
        main = statements[0]
        self._compile(main)
        self._handles = itertools.count(1)
        self._spent = 0
        self.threads: dict[int, Iterator[None]] = {0: self._run(main)}

    def step(self) -> None:
        """Run one control cycle; UrscriptError for a program that cannot go on. The main thread's end is the end."""
        for handle, thread in list(self.threads.items()):
            self._spent = 0
            if handle in self.threads and next(thread, _ENDED) is _ENDED:
                del self.threads[handle]
        if 0 not in self.threads:
            self.threads.clear()

    def _compile(self, statement: Statement) -> None:
        """Note the functions and threads, and check all expressions for what is not there."""
        for inner in (*statement.block, *statement.branches):
            if match := re.fullmatch(rf"(def|thread) ({NAME})\(\):", inner.text):
                self._bodies[match[2]] = inner
            self._compile(inner)
        expression = re.sub(rf"^((if|elif|while) |(global )?{NAME} = (run )?|kill )", "", statement.text)
        if re.match(r"(def|thread) |else:", statement.text):
            return
        for node in ast.walk(_parse(expression.removesuffix(":"), statement)) if statement.text else ():
            if isinstance(node, ast.Call):
                name = node.func.id if isinstance(node.func, ast.Name) else ""
                if not any(name in names for names in (self._functions, self._motions, self._bodies)):
                    _fail(statement, f"there is no function {name or ast.unparse(node.func)!r}")

    def _run(self, body: Statement) -> Iterator[None]:
        yield from self._execute(body.block, {})

    def _execute(self, block: list[Statement], scope: dict[str, Any]) -> Iterator[None]:
        for statement in block:
            self._spend(statement)
            text = statement.text
            if text.startswith(("def ", "thread ")):
                continue
            if text.startswith("if "):
                for branch in (statement, *statement.branches):
                    if branch.text == "else:" or self._is_true(branch, scope):
                        yield from self._execute(branch.block, scope)
                        break
            elif text.startswith("while "):
                while self._is_true(statement, scope):
                    self._spend(statement)
                    yield from self._execute(statement.block, scope)
            elif match := re.fullmatch(rf"kill ({NAME})", text):
                self.threads.pop(self._read(match[1], statement, scope), None)
            elif match := re.fullmatch(rf"(global )?({NAME}) = (run )?(.+)", text):
                self._assign(
                    match[2], self._value(match[3], match[4], statement, scope), bool(match[1]), statement, scope
                )
            else:
                yield from self._call(_parse(text, statement), statement, scope)

    def _spend(self, statement: Statement) -> None:
        self._spent += 1
        if self._spent > MAX_STATEMENTS:
            _fail(statement, "the thread used too much time")

    def _value(self, run: str | None, text: str, statement: Statement, scope: Mapping[str, Any]) -> Any:
        if not run:
            return self._evaluate(_parse(text, statement), statement, scope)
        body = self._bodies.get(text.removesuffix("()"))
        if body is None or not body.text.startswith("thread "):
            _fail(statement, f"there is no thread {text}")
        handle = next(self._handles)
        self.threads[handle] = self._run(body)
        return handle

    def _assign(self, name: str, value: Any, declares: bool, statement: Statement, scope: dict[str, Any]) -> None:
        variables = self._globals if declares or (name in self._globals and name not in scope) else scope
        if name in variables and type(variables[name]) is not type(value):
            _fail(statement, f"{name} is {type(variables[name]).__name__}, and {value!r} is not")
        variables[name] = value

    def _call(self, node: ast.expr, statement: Statement, scope: Mapping[str, Any]) -> Iterator[None]:
        """Execute a call that stands as a statement."""
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            _fail(statement, "this is no statement")
        if body := self._bodies.get(node.func.id):
            if node.args or node.keywords or not body.text.startswith("def "):
                _fail(statement, "this is not how it is called")
            yield from self._run(body)
        elif motion := self._motions.get(node.func.id):
            yield from self._invoke(motion, node, statement, scope)
        else:
            self._evaluate(node, statement, scope)

    def _invoke(self, function: Function, node: ast.Call, statement: Statement, scope: Mapping[str, Any]) -> Any:
        arguments = [self._evaluate(argument, statement, scope) for argument in node.args]
        keywords = {word.arg or "": self._evaluate(word.value, statement, scope) for word in node.keywords}
        try:
            signature = _signature(function)
            bound = signature.bind(*arguments, **keywords)
            for name, value in bound.arguments.items():
                expected = signature.parameters[name].annotation
                if not (type(value) is expected or (expected is float and type(value) is int)):
                    raise TypeError(f"{name} has to be {expected.__name__}, got {value!r}")
            return function(*bound.args, **bound.kwargs)
        except (TypeError, ValueError) as error:
            _fail(statement, str(error))

    def _is_true(self, statement: Statement, scope: Mapping[str, Any]) -> bool:
        text = statement.text.split(" ", 1)[1].removesuffix(":")
        value = self._evaluate(_parse(text, statement), statement, scope)
        return _typed(value, bool, statement)

    def _read(self, name: str, statement: Statement, scope: Mapping[str, Any]) -> Any:
        if name not in scope and name not in self._globals:
            _fail(statement, f"{name} has no value")
        return scope[name] if name in scope else self._globals[name]

    def _evaluate(self, node: ast.expr, at: Statement, scope: Mapping[str, Any]) -> Any:
        def evaluate(inner: ast.expr, *types: type) -> Any:
            value = self._evaluate(inner, at, scope)
            return _typed(value, types, at) if types else value

        match node:
            case ast.Constant(value=bool() | int() | float() as value):
                return value
            case ast.Name(id=name):
                return self._read(name, at, scope)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return not evaluate(operand, bool)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -evaluate(operand, *NUMBERS)
            case ast.BoolOp(op=op, values=values):
                combine = all if isinstance(op, ast.And) else any
                return combine([evaluate(value, bool) for value in values])  # all, so that all are checked
            case ast.BinOp(left=a, op=op, right=b) if type(op) in ARITHMETIC:
                return ARITHMETIC[type(op)](evaluate(a, *NUMBERS), evaluate(b, *NUMBERS))
            case ast.Compare(left=a, ops=[op], comparators=[b]) if type(op) in ORDER:
                return ORDER[type(op)](evaluate(a, *NUMBERS), evaluate(b, *NUMBERS))
            case ast.Compare(left=a, ops=[op], comparators=[b]) if type(op) in EQUALITY:
                return EQUALITY[type(op)](first := evaluate(a), evaluate(b, *_comparable(first)))
            case ast.Subscript(value=ast.Name(id="p"), slice=ast.Tuple(elts=elements)) if len(elements) == 6:
                return Pose(float(evaluate(element, *NUMBERS)) for element in elements)
            case ast.Subscript(value=value, slice=index):
                pose, i = evaluate(value, Pose), evaluate(index, int)
                return pose[i] if 0 <= i < len(pose) else _fail(at, f"index {i} is out of bounds")
            case ast.Call(func=ast.Name(id=name)) if name in self._functions:
                return self._invoke(self._functions[name], node, at, scope)
        _fail(at, f"{ast.unparse(node)!r} is not of the subset")


_ENDED = object()


def _parse_block(lines: Iterator[tuple[int, str]], head: Statement, nested: bool = True) -> list[Statement]:
    """Parse the lines up to the `end` of a block; a branch of an `if` begins a new part of it."""
    part = head
    for line, text in lines:
        if text == "end":
            if not nested:
                raise UrscriptError(f"line {line}: end of nothing")
            return head.block
        statement = Statement(line, text)
        if text == "else:" or text.startswith("elif "):
            if not head.text.startswith("if "):
                _fail(statement, "there is no if")
            head.branches.append(part := statement)
        else:
            part.block.append(statement)
            if text.endswith(":"):
                _parse_block(lines, statement)
    if nested:
        _fail(head, "it has no end")
    return head.block


def _parse(text: str, statement: Statement) -> ast.expr:
    try:
        return _tree(text)
    except SyntaxError:
        _fail(statement, "syntax error")


@functools.cache
def _tree(text: str) -> ast.expr:
    return ast.parse(text, mode="eval").body


@functools.lru_cache(64)
def _signature(function: Function) -> inspect.Signature:
    return inspect.signature(function)


def _typed(value: Any, types: type | tuple[type, ...], statement: Statement) -> Any:
    """Return a value of one of the types; a bool is no int here."""
    if type(value) not in (types if isinstance(types, tuple) else (types,)):
        _fail(statement, f"{value!r} is of the wrong type")
    return value


def _comparable(value: Any) -> tuple[type, ...]:
    return NUMBERS if type(value) in NUMBERS else (type(value),)


def _fail(statement: Statement, message: str) -> NoReturn:
    raise UrscriptError(f"line {statement.line}, {statement.text}: {message}")
