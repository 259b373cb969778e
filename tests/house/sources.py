"""The sources that the house is made of: each is parsed once for all tests here."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]


@cache
def nodes_of(source: str) -> list[ast.AST]:
    """Return the nodes of a source's syntax tree, its module first."""
    return list(ast.walk(ast.parse(source)))
