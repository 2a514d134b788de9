"""What the README and the documentation pages show works as shown."""

from __future__ import annotations

import functools
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_TOP = (ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md"))
PAGES = [*_TOP, *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "research").glob("*.md"))]
FENCE = re.compile(r"^```(?P<language>[a-z]+)\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?P<target>[^)\s]+)\)|src=\"(?P<source>[^\"]+)\"")
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


def _blocks(*languages: str) -> list[object]:
    """Return (page, code) of every fenced block, its test id naming page and line."""
    return [
        pytest.param(page, match["code"], id=f"{page.name}:{text.count(chr(10), 0, match.start()) + 2}")
        for page in PAGES
        for text in [page.read_text(encoding="utf-8")]
        for match in FENCE.finditer(text)
        if match["language"] in languages
    ]


def _commands(program: str) -> list[object]:
    """Return the arguments of every line in a shell block that calls a program, continuation lines joined."""
    found = []
    for block in _blocks("bash", "sh", "console"):
        page, code = block.values  # type: ignore[attr-defined]
        for line in code.replace("\\\n", " ").splitlines():
            words = shlex.split(line.removeprefix("$ "), comments=True)
            if words and words[0] == program:
                found.append(pytest.param(words[1:], id=f"{page.name}: {' '.join(words)[:60]}"))
    return found


@functools.cache
def _help(*command: str) -> str:
    line = [sys.executable, "-m", "cura_torchrl.trainers.cli", *command, "--help"]
    result = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{' '.join(command)} --help failed: {result.stderr.strip()[-500:]}"
    return result.stdout


@pytest.mark.parametrize(("page", "code"), _blocks("python"))
def test_python_blocks_run(page: Path, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an example that names something renamed, or asserts something that is no longer so."""
    monkeypatch.chdir(tmp_path)
    exec(compile(code, page.name, "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("words", _commands("cura-torchrl"))
def test_shown_commands_exist_with_their_flags(words: list[str]) -> None:
    """Catches a command or flag in the documentation that the command line does not have (any more)."""
    text = _help(words[0]) if words[0] != "--help" else _help()
    if "--" in words:  # what follows is for another command
        end = words.index("--")
        words, others = words[:end], words[end + 1 :]
        test_shown_commands_exist_with_their_flags(["train", *others])
    flags = [word.partition("=")[0] for word in words[1:] if word.startswith("--")]
    assert [flag for flag in flags if not re.search(rf"{re.escape(flag)}\b", text)] == []


@pytest.mark.parametrize("words", _commands("make"))
def test_shown_make_targets_exist(words: list[str]) -> None:
    """Catches a make target in the documentation that the Makefile does not have."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = [word for word in words if "=" not in word]
    assert [target for target in targets if not re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_relative_links_point_at_files(page: Path) -> None:
    """Catches a page or picture that was moved or never made; what stands in comments is not shown."""
    text = COMMENT.sub("", FENCE.sub("", page.read_text(encoding="utf-8")))
    targets = [match["target"] or match["source"] for match in LINK.finditer(text)]
    local = [target.partition("#")[0] for target in targets if not target.startswith(("http", "#", "mailto:"))]
    assert [target for target in local if not (page.parent / target).exists()] == []
