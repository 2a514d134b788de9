"""Claims about the repository as a whole: what the linters cannot see."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pytest brings it along on Python 3.10

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "cura_torchrl"
MODULES = sorted(PACKAGE.rglob("*.py"))
SCRIPTS = sorted(path for folder in ("tests", "benchmarks", "examples") for path in (ROOT / folder).rglob("*.py"))
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 50
PUBLIC_NAMES = {
    "CURAAdvantage",
    "CURALoss",
    "ConfidenceMap",
    "DistributionalCollisionEstimator",
    "EncodeMap",
    "MapVAE",
    "PushEnv",
    "register_gym",
}


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _repository_files() -> list[Path]:
    """Files that are tracked or about to be; without git (a source archive) what lies in no hidden or built folder."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, check=False)
    if listing.returncode == 0:
        return [path for name in listing.stdout.decode().split("\0") if name and (path := ROOT / name).is_file()]
    tops = [
        path for path in ROOT.iterdir() if not path.name.startswith(".") and path.name not in {"build", "dist", "runs"}
    ]
    files = [file for top in tops for file in (top.rglob("*") if top.is_dir() else [top])]
    return [file for file in files if file.is_file() and "__pycache__" not in file.parts]


def _dotted(node: ast.expr) -> str:
    """Return ``a.b.c`` for an attribute chain, the empty string for anything else."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


def _imports(tree: ast.Module) -> set[str]:
    """Return the top-level names of the modules that a file imports, wherever the import stands."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.partition(".")[0])
    return found


def _keyword(call: ast.Call, name: str) -> object:
    """Return the constant a call passes by keyword, or None."""
    values = [keyword.value for keyword in call.keywords if keyword.arg == name]
    return values[0].value if values and isinstance(values[0], ast.Constant) else None


def _unsafe(call: ast.Call) -> str | None:
    """Return what is wrong with a call that could run code from a file, or None."""
    function = _dotted(call.func)
    if function in {"eval", "exec", "yaml.load", "yaml.unsafe_load", "os.system", "os.popen"}:
        return function
    if function == "torch.load" and _keyword(call, "weights_only") is not True:
        return "torch.load without weights_only=True"
    if _keyword(call, "weights_only") is False or _keyword(call, "allow_pickle") is True:
        return f"{function} with pickle"
    return f"{function} with a shell" if _keyword(call, "shell") is True else None


def test_no_file_names_a_path_of_one_machine() -> None:
    """Catches a path of the author's machine in code, docs or data: it works nowhere else."""
    folders = "|".join(["work", "farm", "root"])
    pattern = re.compile(rf"/(?:{folders})/|(?<![\w./:-])/(?:home|Users)/".encode())
    found = [
        f"{_name(path)}:{number}"
        for path in _repository_files()
        if b"\0" not in (content := path.read_bytes())  # text
        for number, line in enumerate(content.splitlines(), start=1)
        if pattern.search(line)
    ]
    assert found == []


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_package_reads_no_file_that_could_run_code(path: Path) -> None:
    """Catches a loader that executes what a checkpoint or config contains (pickle, yaml.load, eval, a shell)."""
    tree = _tree(path)
    assert _imports(tree).isdisjoint({"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"})
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert [(call.lineno, problem) for call in calls if (problem := _unsafe(call))] == []


@pytest.mark.parametrize("path", MODULES + SCRIPTS, ids=_name)
def test_files_and_functions_stay_short(path: Path) -> None:
    """Catches a file or function that has outgrown what a reader can hold; docstrings do not count for functions."""
    num_lines = len(path.read_text(encoding="utf-8").splitlines())
    assert num_lines <= MAX_FILE_LINES
    long = []
    for node in ast.walk(_tree(path)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            docstring = ast.get_docstring(node, clean=False)
            lines = (node.end_lineno or node.lineno) - node.lineno - (docstring.count("\n") + 1 if docstring else 0)
            if lines > MAX_FUNCTION_LINES:
                long.append((node.name, lines))
    assert long == []


def test_public_names_are_importable() -> None:
    """Catches a public name that the lazy package lists but cannot deliver, or delivers without listing."""
    package = importlib.import_module("cura_torchrl")
    assert set(package.__all__) >= PUBLIC_NAMES
    assert set(dir(package)) >= PUBLIC_NAMES
    for name in package.__all__:
        assert getattr(package, name) is not None


@pytest.mark.parametrize("path", [path for path in MODULES if path.name == "__init__.py"], ids=_name)
def test_subpackages_deliver_what_they_list(path: Path) -> None:
    """Catches a name in ``__all__`` that was renamed or removed."""
    module = importlib.import_module(".".join(path.parent.relative_to(ROOT).parts))
    missing = [name for name in getattr(module, "__all__", []) if not hasattr(module, name)]
    assert missing == []


def test_an_unknown_name_of_the_package_is_an_attribute_error() -> None:
    """Catches a lazy ``__getattr__`` that answers a misspelt name with something else than Python's own error."""
    package = importlib.import_module("cura_torchrl")
    with pytest.raises(AttributeError, match="CURALos"):
        _ = package.CURALos


def test_importing_the_package_imports_neither_simulator_nor_torch() -> None:
    """Catches an import at package level that makes ``--help`` slow or needs PyBullet for a loss."""
    heavy = ("pybullet", "torch", "torchrl", "tensordict", "matplotlib")
    code = f"import sys, cura_torchrl; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_learning_imports_no_simulator() -> None:
    """Catches objectives, modules or transforms that need PyBullet: they must serve any TorchRL environment."""
    code = (
        "import sys, cura_torchrl.objectives, cura_torchrl.modules, cura_torchrl.envs.transforms;"
        "print([name for name in ('pybullet', 'matplotlib', 'tyro') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def _requirements(*extras: str) -> set[str]:
    """Return the normalised names of what pyproject.toml requires, extras included."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = project["dependencies"] + [line for extra in extras for line in project["optional-dependencies"][extra]]
    return {_normalise(re.split(r"[\s<>=!~\[(;]", line, maxsplit=1)[0]) for line in lines}


def _normalise(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_third_party_import_is_a_declared_dependency() -> None:
    """Catches a module that works only because another package happens to bring its import along."""
    distributions = importlib.metadata.packages_distributions()
    declared = _requirements("tensorboard", "wandb", "ray", "peers", "export", "gym", "video", "table", "live")
    undeclared = set()
    for path in MODULES:
        for module in _imports(_tree(path)) - set(sys.stdlib_module_names) - {"cura_torchrl"}:
            names = {_normalise(name) for name in distributions.get(module, [module])}
            if names.isdisjoint(declared):
                undeclared.add((module, _name(path)))
    assert undeclared == set()


def test_constraints_pin_every_requirement_exactly() -> None:
    """Catches a dependency that is added to pyproject.toml alone: a fresh install would then drift with time."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    assert _requirements("test") <= {_normalise(name) for name in pins}
    assert pins["torch"] == "2.13.0"
