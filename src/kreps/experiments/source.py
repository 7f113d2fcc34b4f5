"""Hashes of the package's source, by definition: what changes when a result may change.

A definition is named ``module:qualified.name``: a function, a class without its methods, or a
constant of a module.  Its hash is of the syntax tree without comments, docstrings, annotations of
arguments, and what is raised: texts may be improved without a new hash.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass
class Source:
    """The definitions of a module.

    Attributes:
        nodes: by qualified name.
        imported: kreps names by the name they have here, with "" for the module itself.
        tree: of the whole module.
    """

    nodes: dict[str, ast.AST] = field(default_factory=dict)
    imported: dict[str, tuple[str, str]] = field(default_factory=dict)
    tree: ast.Module = field(default_factory=lambda: ast.Module([], []))


class _Bare(ast.NodeTransformer):
    """Removes what no result depends on."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else self.generic_visit(node)

    def visit_arg(self, node: ast.arg) -> ast.AST:
        return ast.arg(node.arg)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.annotation = ast.Constant(None)
        return self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        return ast.Raise()


def _parsed(text: str) -> ast.Module:
    bare: ast.Module = _Bare().visit(ast.parse(text))
    return bare


@cache
def source(module: str) -> Source | None:
    """The definitions of a module of kreps; None if there is no such module."""
    inside = ROOT.joinpath(*module.split(".")[1:])
    path = inside / "__init__.py" if inside.is_dir() else inside.with_suffix(".py")
    if not path.exists():
        return None
    found = Source(tree=_parsed(path.read_text()))
    for node in ast.walk(found.tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("kreps"):
            for name in node.names:
                found.imported[name.asname or name.name] = (str(node.module), name.name)
    _define(found.tree.body, "", found.nodes)
    return found


def _define(body: Iterable[ast.stmt], owner: str, nodes: dict[str, ast.AST]) -> None:
    for node in body:
        if isinstance(node, FUNCTIONS):
            # the setter of a property has its name, too
            same = nodes.get(owner + node.name)
            nodes[owner + node.name] = ast.Module([same, node], []) if same else node  # type: ignore[list-item]
        elif isinstance(node, ast.ClassDef):
            _define(node.body, f"{owner}{node.name}.", nodes)
            kept = [each for each in node.body if not isinstance(each, FUNCTIONS)]
            nodes[owner + node.name] = ast.ClassDef(
                node.name, node.bases, node.keywords, kept, node.decorator_list
            )
        elif not owner and isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                for name in ast.walk(target):
                    if isinstance(name, ast.Name):
                        nodes[name.id] = node
        elif isinstance(node, ast.If | ast.Try):
            _define(ast.iter_child_nodes(node), owner, nodes)  # type: ignore[arg-type]


def read_all() -> None:
    """Read all modules now: files may change while the code that was imported runs."""
    for path in ROOT.rglob("*.py"):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        source(".".join(parts[:-1] if parts[-1] == "__init__" else parts))


def node_of(name: str) -> ast.AST | None:
    """The syntax tree of ``module:name``, or of a whole ``module``; None if there is none."""
    module, _, inside = name.partition(":")
    found = source(module)
    if found is None:
        return None
    return found.nodes.get(inside) if inside else found.tree


@cache
def hash_of(name: str) -> str | None:
    """The hash of ``module:name``, or of a whole ``module``; None if there is no such thing."""
    node = node_of(name)
    return None if node is None else _hash(node)


def _hash(node: ast.AST) -> str:
    return hashlib.sha256(repr(_plain(node)).encode()).hexdigest()[:12]


def _plain(value: object) -> object:
    """The tree as tuples without empty fields, in which versions of Python differ."""
    if isinstance(value, list):
        return tuple(map(_plain, value))
    if not isinstance(value, ast.AST):
        return value
    fields = [
        (name, _plain(each)) for name, each in ast.iter_fields(value) if each not in (None, [])
    ]
    return type(value).__name__, *fields


def hash_of_file(path: Path) -> str:
    """The hash of a Python file outside the package."""
    return _hash(_parsed(path.read_text()))


def referred(name: str) -> Iterator[str]:
    """The constants and classes that a definition names, and the functions that are called to
    define a constant or a class: what else its result depends on.
    """
    module, _, inside = name.partition(":")
    node, own = node_of(name), source(module)
    if node is None or own is None:
        return
    in_function = isinstance(node, FUNCTIONS) or "." in inside
    called = {id(each.func) for each in ast.walk(node) if isinstance(each, ast.Call)}
    for each in ast.walk(node):
        found = _resolved(module, each)
        target = node_of(found) if found else None
        if found is None or target is None or found == name:
            continue
        if not isinstance(target, FUNCTIONS) or (id(each) in called and not in_function):
            yield found


def _resolved(module: str, node: ast.AST) -> str | None:
    """The definition that an expression names: ``NAME`` or ``module.NAME``."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        owner = _module_of(module, node.value.id)
        return _definition(owner, node.attr) if owner else None
    return _definition(module, node.id) if isinstance(node, ast.Name) else None


def _module_of(module: str, name: str) -> str | None:
    """The module that a name of another module stands for."""
    found = source(module)
    parent, inside = found.imported.get(name, ("", "")) if found else ("", "")
    return f"{parent}.{inside}" if parent and source(f"{parent}.{inside}") else None


def _definition(module: str, name: str) -> str | None:
    """Where a name of a module is defined, through imports of imports."""
    found = source(module)
    if found is None:
        return None
    if name in found.nodes:
        return f"{module}:{name}"
    if name in found.imported:
        return _definition(*found.imported[name])
    return None


def reachable(modules: Iterable[str]) -> set[str]:
    """These modules and all that they import, directly or not."""
    open_, found = list(modules), set[str]()
    while open_:
        module = open_.pop()
        own = source(module)
        if own is None or module in found:
            continue
        found.add(module)
        for parent, name in own.imported.values():
            open_ += [parent, f"{parent}.{name}"]
    return found


def imports_of_file(path: Path) -> list[str]:
    """The modules of kreps that a Python file outside the package imports."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("kreps"):
            names += [str(node.module), *(f"{node.module}.{name.name}" for name in node.names)]
        elif isinstance(node, ast.Import):
            names += [name.name for name in node.names if name.name.startswith("kreps")]
    return names
