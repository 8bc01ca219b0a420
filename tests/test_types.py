"""Type hints everywhere but in kernels, also in the modules in which mypy does not ask for them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).parent.parent / "src"
KERNELS = {"njit", "jit", "intrinsic", "kernel", "helper", "inline"}
"""Decorators of what Numba or Triton types."""


def is_kernel(function: ast.FunctionDef) -> bool:
    decorators = [each.func if isinstance(each, ast.Call) else each for each in function.decorator_list]
    names = {each.attr if isinstance(each, ast.Attribute) else getattr(each, "id", None) for each in decorators}
    return bool(KERNELS & names)


def untyped(node: ast.AST) -> Iterator[str]:
    """The functions without all of their type hints, kernels excepted."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef):
            if is_kernel(child):
                continue
            found = child.args
            arguments = [*found.posonlyargs, *found.args, *found.kwonlyargs, found.vararg, found.kwarg]
            bare = [each for each in arguments if each is not None and each.annotation is None and each.arg not in ("self", "cls")]
            if bare or (child.returns is None and child.name != "__init__"):
                yield f"{child.name}:{child.lineno}"
        yield from untyped(child)


def test_functions_have_type_hints():
    modules = {str(path.relative_to(SOURCE)): path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py")}
    found = {path: list(untyped(ast.parse(text))) for path, text in modules.items()}
    assert len(found) > 100
    assert {path: names for path, names in found.items() if names} == {}


def test_what_lacks_hints_is_found():
    module = """
@njit(cache=True)
def kernel(a): ...
class A:
    def __init__(self, a: int): ...
    def b(self, c) -> None:
        def d(): ...
"""
    assert list(untyped(ast.parse(module))) == ["b:6", "d:7"]
