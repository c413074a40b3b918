"""Structure of the product: size of the operator contract, circles of imports, long modules and
functions, wrong imports.

    python benchmarks/structure.py             # the figures
    python benchmarks/structure.py --verbose   # and what they consist of

Lazy imports and imports for type checking count like any others. Kernels and click commands may be
long and take many parameters. `tests/test_structure.py` holds the figures below limits. Only the
standard library is needed.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("core", "operators", "plugins", "interop", "pipelines", "zonda")
LONGEST_MODULE, LONGEST_FUNCTION, MOST_PARAMETERS, LONGEST_OPERATOR = 400, 60, 7, 60
WORK = {"observe", "check", "configure", "prepare", "measure", "exec", "collect", "finalize"}
WORK |= {"requires", "provides", "optional", "linear", "all_bands", "exec_bands"}
"""Methods in which an operator does its work and properties that state what it needs; other public
methods are there for the framework only.
"""


@dataclass
class Module:
    """A source file."""

    name: str
    text: str
    tree: ast.Module

    @property
    def package(self) -> list[str]:
        return self.name.split(".")[:-1]

    @property
    def lines(self) -> int:
        return len(self.text.splitlines())


@dataclass
class Figure:
    """One measured property: its value, and what it consists of."""

    value: int
    items: list[str]


def modules(root: Path = ROOT) -> dict[str, Module]:
    """All modules of the product by name; folders that are links are left out."""
    found = {}
    for part in PARTS:
        for path in sorted((root / part).rglob("*.py")):
            if any(parent.is_symlink() for parent in path.parents):
                continue
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            text = path.read_text(encoding="utf-8")
            found[name] = Module(name, text, ast.parse(text))
    return found


def imports(product: dict[str, Module]) -> dict[str, set[str]]:
    """The modules of the product that each imports, anywhere in its text."""
    return {
        name: {target for target in _targets(module, product) if target != name}
        for name, module in product.items()
    }


def _targets(module: Module, product: dict[str, Module]) -> Iterator[str]:
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            named = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = [*module.package[: len(module.package) - node.level + 1]] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            named = [f"{stem}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in named:
            if name.split(".")[0] in PARTS and (
                target := _module_of(name.removeprefix("zonda."), product)
            ):
                yield target


def _module_of(name: str, product: dict[str, Module]) -> str | None:
    """The module that holds a dotted name."""
    while name:
        for candidate in (name, f"{name}.__init__"):
            if candidate in product:
                return candidate
        name = name.rpartition(".")[0]
    return None


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other in a circle, the largest first."""
    reach = {name: _reachable(name, edges) for name in edges}
    groups: list[list[str]] = []
    seen: set[str] = set()
    for name in sorted(edges):
        if name not in seen and name in reach[name]:
            group = sorted(other for other in reach[name] if name in reach[other])
            seen.update(group)
            groups.append(group)
    return sorted(groups, key=len, reverse=True)


def _reachable(name: str, edges: dict[str, set[str]]) -> set[str]:
    found: set[str] = set()
    left = list(edges[name])
    while left:
        target = left.pop()
        if target not in found:
            found.add(target)
            left.extend(edges[target])
    return found


def _docstring(
    node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module,
) -> ast.Expr | None:
    first = node.body[0] if node.body else None
    return first if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) else None


def _size(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines besides the docstring."""
    doc = _docstring(node)
    return _span(node) - (_span(doc) if doc else 0)


def _span(node: ast.stmt) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


def _functions(
    product: dict[str, Module],
) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Every function but kernels and click commands, with its place."""
    for module in product.values():
        for node in ast.walk(module.tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                decorators = " ".join(ast.unparse(d) for d in node.decorator_list)
                if not re.search("jit|intrinsic|click|option|command", decorators):
                    yield f"{module.name}.{node.name}", node


def _parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    a = node.args
    return (
        len(a.posonlyargs)
        + len(a.args)
        + len(a.kwonlyargs)
        - (bool(a.args) and a.args[0].arg in ("self", "cls"))
    )


def _class(product: dict[str, Module], module: str, name: str) -> ast.ClassDef:
    return next(
        n for n in product[module].tree.body if isinstance(n, ast.ClassDef) and n.name == name
    )


def shipped(root: Path = ROOT) -> dict[str, str]:
    """Shipped operators and map makers: class name and module."""
    groups = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "entry-points"
    ]
    places = [
        value
        for group in ("zonda.operators", "zonda.mapmakers")
        for value in groups.get(group, {}).values()
    ]
    return {
        place.partition(":")[2]: place.partition(":")[0].removeprefix("zonda.") for place in places
    }


def _named_in_core(product: dict[str, Module], operators: set[str]) -> list[str]:
    """Operators that code or messages of core name; docstrings may give examples."""
    word = re.compile(r"\b(" + "|".join(sorted(operators)) + r")\b")
    found = []
    for module in product.values():
        if not module.name.startswith("core."):
            continue
        docs = {
            id(doc.value)
            for n in ast.walk(module.tree)
            if hasattr(n, "body") and isinstance(n.body, list)
            for doc in [_docstring(n)]
            if doc
        }
        docs |= {
            id(n.value)
            for n in ast.walk(module.tree)
            if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)
        }
        for node in ast.walk(module.tree):
            text = ""
            if (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and id(node) not in docs
            ):
                text = node.value
            elif isinstance(node, ast.Name | ast.alias):
                text = node.id if isinstance(node, ast.Name) else node.name
            found += [f"{module.name}:{node.lineno} {match}" for match in word.findall(text)]
    return found


def measure(root: Path = ROOT) -> dict[str, Figure]:
    """All figures, by name."""
    product = modules(root)
    edges = imports(product)
    operator = _class(product, "core.operator", "Operator")
    methods = [
        n.name
        for n in operator.body
        if isinstance(n, ast.FunctionDef) and not n.name.startswith("_")
    ]
    attributes = [
        ast.unparse(n.target)
        for n in operator.body
        if isinstance(n, ast.AnnAssign) and "ClassVar" in ast.unparse(n.annotation)
    ]
    groups = circles(edges)
    pairs = sorted((a, b) for a, targets in edges.items() for b in targets)
    places = shipped(root)
    sizes = {name: _span(_class(product, module, name)) for name, module in places.items()}
    bin_map = _class(product, places["BinMap"], "BinMap")
    hooks = [
        n
        for n in bin_map.body
        if isinstance(n, ast.FunctionDef) and not n.name.startswith("_") and n.name not in WORK
    ]

    def of(items: list[str]) -> Figure:
        return Figure(len(items), items)

    functions = list(_functions(product))
    return {
        "product lines": Figure(sum(m.lines for m in product.values()), []),
        "methods and properties of Operator": of(methods),
        "class attributes of Operator": of([a for a in attributes if not a.startswith("zonda_")]),
        "modules in the largest circle of imports": Figure(
            len(groups[0]) if groups else 0, [", ".join(g) for g in groups]
        ),
        "modules over 400 lines": of(
            [f"{m.name}: {m.lines}" for m in product.values() if m.lines > LONGEST_MODULE]
        ),
        "functions over 60 lines": of(
            [f"{place}: {_size(n)}" for place, n in functions if _size(n) > LONGEST_FUNCTION]
        ),
        "functions of more than 7 parameters": of(
            [
                f"{place}: {_parameters(n)}"
                for place, n in functions
                if _parameters(n) > MOST_PARAMETERS
            ]
        ),
        "imports between siblings of operators": of(
            [f"{a} -> {b}" for a, b in pairs if _siblings(a, b)]
        ),
        "upward imports": of([f"{a} -> {b}" for a, b in pairs if _upward(a, b)]),
        "operators that core names": of(_named_in_core(product, set(places))),
        "operators whose class is over 60 lines": of(
            [f"{n}: {s}" for n, s in sizes.items() if s > LONGEST_OPERATOR]
        ),
        "operators whose class fits 60 lines": of(
            [f"{n}: {s}" for n, s in sizes.items() if s <= LONGEST_OPERATOR]
        ),
        "lines of framework hooks in BinMap": Figure(
            sum(_span(n) for n in hooks), [n.name for n in hooks]
        ),
    }


def _siblings(a: str, b: str) -> bool:
    return (
        a.startswith("operators.")
        and b.startswith("operators.")
        and a.split(".")[1] != b.split(".")[1]
    )


def _upward(a: str, b: str) -> bool:
    order = {"core": 0, "operators": 1, "plugins": 2, "interop": 3}
    return order.get(a.split(".")[0], 3) < order.get(b.split(".")[0], -1)


def main() -> None:
    """Print the figures."""
    for name, figure in measure().items():
        print(f"{figure.value:7d}  {name}")
        if "--verbose" in sys.argv:
            print("".join(f"           {item}\n" for item in figure.items), end="")


if __name__ == "__main__":
    main()
