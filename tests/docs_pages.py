"""README and the site's pages as a reader follows them: every command and program of a page, in order, in one folder.

    python tests/docs_pages.py docs/tutorials/first-drive.md     # runs a page and writes what it printed into the page

How a page is written:

- A block in `bash` (or without a language) holds commands, each of which must end with 0; `<!-- exits: 1 -->` before
  the block says otherwise of its last. In `console` the lines after `$ ` are commands and the others what they print.
- A block in `python` goes on with what the page's blocks before it have defined, as in one interpreter. One that is
  nothing but a script of `examples/` is run by a command of the same page.
- A block in `text` right after those is what they print: numbers may differ, unless `<!-- exact -->` stands before it,
  and a line of three dots stands for any lines.
- A block with `title="name"` is written to that file.
- `<!-- not run: reason -->` before a block says why it cannot be run here.
"""

from __future__ import annotations

import os
import pty
import queue
import re
import signal
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time
from pathlib import Path

MACHINERY = Path(__file__).resolve().parent.parent / "docs" / "machinery"
sys.path.append(str(MACHINERY))
from page_blocks import ROOT, Block, blocks  # noqa: E402

PORT = 29636  # that of `drive-env serve`
PATIENCE, SERVED = 900.0, 120.0  # s, of one command; until a drive is served
END = "@@ended@@"

SERVES = re.compile(r"^\s*drive-env serve\b(?!.*(--help|--duration))")
# What comes and goes: bars, and the kernels' first compilation.
PASSING = re.compile(r"━━|compiling the kernels|^\s*$")

SESSION = """
import sys, traceback
namespace = {"__name__": "__main__"}
while True:
    path = sys.stdin.readline().strip()
    if not path:
        break
    code = 0
    try:
        exec(compile(open(path, encoding="utf-8").read(), "the page", "exec"), namespace)
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stderr.flush()
    print("%s", code, flush=True)
""" % (END,)  # noqa: UP031  # braces are the program's


def environment() -> dict[str, str]:
    programs = str(Path(sys.executable).parent)
    ours = {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", "PYTHONUNBUFFERED": "1", "MPLBACKEND": "Agg",
            "COLUMNS": "100"}  # fmt: skip
    theirs = {key: value for key, value in os.environ.items()
              if not key.startswith("DRIVE_ENV_") or key == "DRIVE_ENV_CACHE"}  # fmt: skip
    return theirs | ours


class Session:
    """A program that takes one piece after the other, with a keyboard on which somebody says yes."""

    def __init__(self, command: list[str], folder: Path) -> None:
        self._keyboard, terminal = pty.openpty()
        settings = termios.tcgetattr(terminal)
        settings[3] &= ~termios.ECHO
        termios.tcsetattr(terminal, termios.TCSANOW, settings)
        self.terminal = os.ttyname(terminal)
        self._terminal = terminal
        self._process = subprocess.Popen(
            command, cwd=folder, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )  # fmt: skip
        self._lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._process.stdout:
            self._lines.put(line.rstrip("\n"))
        self._lines.put(None)

    def say(self, text: str) -> None:
        self._process.stdin.write(text + "\n")
        self._process.stdin.flush()

    def agree(self) -> None:
        """Press y, in case that it is asked."""
        termios.tcflush(self._terminal, termios.TCIFLUSH)
        os.write(self._keyboard, b"y\n")

    def answer(self, until: str = END, patience: float = PATIENCE) -> tuple[int, list[str]]:
        """Return the exit code and what was printed."""
        lines: list[str] = []
        ends = time.monotonic() + patience
        while True:
            try:
                line = self._lines.get(timeout=max(ends - time.monotonic(), 0.01))
            except queue.Empty:
                raise AssertionError(f"no {until} after {patience:g} s:\n" + "\n".join(lines)) from None
            if line is None:
                raise AssertionError("it ended:\n" + "\n".join(lines))
            if until == END and END in line:
                rest, _, code = line.partition(END)
                return int(code), [*lines, rest] if rest else lines
            lines.append(line)
            if until != END and until in line:
                return 0, lines

    def close(self) -> None:
        """End it and all that it started."""
        self._process.stdin.close()
        for number in (signal.SIGTERM, signal.SIGKILL):
            try:
                os.killpg(self._process.pid, number)
                self._process.wait(20)
            except ProcessLookupError:
                break
            except subprocess.TimeoutExpired:
                continue
            # Those in the background may outlive the shell for a moment.
            for _ in range(100):
                try:
                    os.killpg(self._process.pid, 0)
                except (ProcessLookupError, PermissionError):
                    break
                time.sleep(0.1)
        self._process.stdout.close()
        os.close(self._keyboard)
        os.close(self._terminal)


class Reader:
    """Somebody who follows a page in a folder of his own, beside which the examples lie."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if not (folder / "examples").exists():
            (folder / "examples").symlink_to(ROOT / "examples")
        self._shell: Session | None = None
        self._python: Session | None = None
        self._file = Path(tempfile.mkdtemp()) / "piece"

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        for session in (self._shell, self._python):
            if session is not None:
                session.close()

    def follow(self, block: Block) -> list[str]:
        """Do what a block says; return what it printed."""
        if block.title:
            path = self.folder / block.title
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding="utf-8")
            return []
        if block.language == "python":
            return self._run_python(block)
        printed: list[str] = []
        commands = block.commands()
        for k, command in enumerate(commands):
            wanted = int(block.marks.get("exits", "0")) if k == len(commands) - 1 else 0
            code, lines = self._run_command(command)
            text = "\n".join(lines)
            assert code == wanted, f"line {block.line}: {command}\nended with {code}, not {wanted}:\n{text}"
            assert "Traceback" not in text, f"line {block.line}: {command}\n{text}"
            printed += lines
        return printed

    def _run_command(self, command: str) -> tuple[int, list[str]]:
        if self._shell is None:
            self._shell = Session(["bash", "--noprofile", "--norc"], self.folder)
        serves = SERVES.match(command)
        if serves and not command.rstrip().endswith("&"):
            command += " &"  # a terminal of its own
        self._file.write_text(command + "\n", encoding="utf-8")
        if not serves:
            self._shell.agree()
            self._shell.say(f"source {self._file} <{self._shell.terminal}; echo {END} $?")
            return self._shell.answer()
        self._shell.say(f"source {self._file} </dev/null")
        return self._shell.answer("can.Bus(", SERVED)

    def _run_python(self, block: Block) -> list[str]:
        if self._python is None:
            self._python = Session([sys.executable, "-c", SESSION], self.folder)
        self._file.write_text(block.text, encoding="utf-8")
        self._python.say(str(self._file))
        code, lines = self._python.answer()
        assert code == 0, f"line {block.line}:\n" + "\n".join(lines)
        return lines


def shape(line: str) -> str:
    """Return a line without its figures, and without what depends on their width."""
    line = re.sub(r"[-+]?\d[\d.,:]*(e[-+]?\d+)?", "#", line)
    return " ".join(re.sub(r"[─━]+", "-", line).split())


def compare(block: Block, printed: list[str]) -> None:
    """Fail where a page's output is not what was printed."""
    exact = "exact" in block.marks
    got = [line for line in printed if not PASSING.search(line)]
    if not exact:
        got = [shape(line) for line in got]
    wanted = [line for line in block.text.splitlines() if not PASSING.search(line)]
    place, free = 0, False
    for line in wanted:
        if line.strip() in ("...", "…"):
            free = True
            continue
        match = line if exact else shape(line)
        while free and place < len(got) and got[place].rstrip() != match.rstrip():
            place += 1
        here = got[place].rstrip() if place < len(got) else "nothing more"
        assert here == match.rstrip(), (
            f"line {block.line}: the page has\n{match}\nand printed was\n{here}\nin all\n" + "\n".join(printed)
            + "\n(python tests/docs_pages.py PAGE writes what is printed into the page)"
        )  # fmt: skip
        place, free = place + 1, False
    assert free or place == len(got), f"line {block.line}: not on the page:\n" + "\n".join(got[place:])


def follow(page: Path, folder: Path, write: bool = False) -> list[tuple[Block, str]]:
    """Do all that a page says, and compare what it says that is printed.

    Args:
        page: The page.
        folder: Where to do it.
        write: Write what was printed into the page in place of comparing it.

    Returns:
        The blocks that cannot be run here, with the reason.
    """
    left: list[tuple[Block, str]] = []
    new: list[tuple[Block, str]] = []
    printed: list[str] | None = None
    with Reader(folder) as reader:
        for block in blocks(page):
            if "not run" in block.marks:
                left.append((block, block.marks["not run"]))
                printed = None
            elif block.only_script:
                printed = None  # run by a command of this page: test_docs.py
            elif block.title or block.is_done:
                printed = reader.follow(block)
            elif block.language == "text" and printed is not None:
                whole = not re.search(r"^(\.\.\.|…)$", block.text, re.M)
                if write and whole:
                    kept = [line.rstrip() for line in printed if not re.search("━━|compiling the kernels", line)]
                    new.append((block, "\n".join(kept).strip("\n") + "\n"))
                else:
                    compare(block, printed)
                printed = None
    text = page.read_text(encoding="utf-8")
    for block, lines in reversed(new):
        indented = re.sub(r"^(?=.)", block.indent, lines, flags=re.M)
        text = text[: block.start] + indented + text[block.end :]
    if write:
        page.write_text(text, encoding="utf-8")
    return left


def port_is_free(wait: float = 0.0) -> bool:
    """Return whether `drive-env serve` can have its port, within a time to wait [s]."""
    ends = time.monotonic() + wait
    while True:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", PORT)) != 0:
                return True
        if time.monotonic() > ends:
            return False
        time.sleep(1.0)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        began = time.monotonic()
        if "drive-env serve" in Path(name).read_text(encoding="utf-8") and not port_is_free(PATIENCE):
            raise SystemExit(f"port {PORT} is taken: end the program that serves there")
        with tempfile.TemporaryDirectory() as place:
            for one, reason in follow(Path(name).resolve(), Path(place), write=True):
                print(f"{name}:{one.line}: not run: {reason}")
        print(f"{name}: {time.monotonic() - began:.0f} s")
