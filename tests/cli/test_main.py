"""The command line's own laws: help, one line per mistake, exit statuses."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import dataclass
from io import BytesIO, TextIOWrapper
from types import ModuleType

import pytest

from poet_loc.cli import main as command_line
from poet_loc.cli.main import COMMANDS, main
from poet_loc.core.input_error import InputError
from poet_loc.io.whole_folder import whole_folder


def one_line(capsys) -> str:
    """What stood on stderr, which must be exactly one line."""
    error = capsys.readouterr().err
    assert error.endswith("\n")
    assert error.count("\n") == 1, error
    assert error.startswith("poet-loc: ")
    return error


@pytest.fixture
def planted(monkeypatch):
    """Put a command called `plant` on the command line that does as told."""

    def plant(execute):
        @dataclass(frozen=True)
        class Arguments:
            """Do as told."""

            count: int = 1
            """How often."""

        module = ModuleType("plant")
        module.Arguments, module.execute = Arguments, execute
        monkeypatch.setitem(COMMANDS, "plant", "does as told")
        monkeypatch.setattr(command_line, "import_module", lambda name: module)

    return plant


def test_overview_names_every_command(capsys):
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in COMMANDS)
    assert main([]) == 0
    assert capsys.readouterr().out == shown
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("poet-loc ")


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "convert"])
def test_help_of_each_command(name, capsys):
    assert main([name, "--help"]) == 0
    shown = capsys.readouterr()
    assert f"usage: poet-loc {name}" in shown.out
    assert shown.err == ""


def test_overview_imports_no_heavy_library():
    program = (
        "import sys; from poet_loc.cli.main import main; main(['--help']); "
        "print(sorted(set(sys.modules) & {'torch', 'gtsam', 'rerun', 'numba', 'matplotlib', 'scipy', 'tyro'}))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["plants"], "unknown command 'plants'"),
        (["plant", "--bogus", "3"], "--bogus"),
        (["plant", "--count", "many"], "--count"),
        (["plant", "--count"], "--count"),
        (["plant", "stray"], "stray"),
    ],
)
def test_wrong_arguments_are_one_line_and_status_1(arguments, said, planted, capsys):
    planted(lambda arguments: pytest.fail("must not run"))
    assert main(arguments) == 1
    line = one_line(capsys)
    assert said in line
    assert "--help" in line or "one of" in line


@pytest.mark.parametrize("arguments", [["plant", "--bogus", "3"], ["plant", "--count", "many"]])
def test_wrong_arguments_are_told_alike_where_there_is_only_ascii(arguments, planted, capsys, monkeypatch):
    planted(lambda arguments: pytest.fail("must not run"))
    assert main(arguments) == 1
    usual = one_line(capsys)
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(BytesIO(), encoding="ascii"))
    assert main(arguments) == 1
    assert one_line(capsys) == usual


def test_a_user_mistake_is_one_line_and_status_1(planted, capsys):
    def execute(arguments):
        raise InputError("stamps go backwards", path="imu.csv", line=7, fix="sort the file")

    planted(execute)
    assert main(["plant"]) == 1
    assert one_line(capsys) == "poet-loc: imu.csv:7: stamps go backwards; sort the file\n"


def test_a_file_that_the_system_refuses_is_one_line(planted, capsys, tmp_path):
    planted(lambda arguments: (tmp_path / "none").read_text())
    assert main(["plant"]) == 1
    assert one_line(capsys) == f"poet-loc: {tmp_path / 'none'}: no such file or directory\n"


def test_interruption_is_one_line_and_status_130(planted, capsys):
    def execute(arguments):
        raise KeyboardInterrupt

    planted(execute)
    assert main(["plant"]) == 130
    assert one_line(capsys) == "poet-loc: interrupted\n"


def test_termination_tidies_up_as_an_interruption_does(planted, tmp_path, capsys):
    before = signal.getsignal(signal.SIGTERM)

    def execute(arguments):
        with whole_folder(tmp_path / "run"):
            signal.raise_signal(signal.SIGTERM)

    planted(execute)
    assert main(["plant"]) == 143
    assert one_line(capsys) == "poet-loc: terminated\n"
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_bug_keeps_its_traceback(planted):
    def execute(arguments):
        raise ZeroDivisionError

    planted(execute)
    with pytest.raises(ZeroDivisionError):
        main(["plant"])


def test_arguments_and_warnings_reach_their_place(planted, capsys):
    import warnings

    def execute(arguments):
        warnings.warn("the header\nwas repaired", stacklevel=2)
        print(arguments.count)

    planted(execute)
    assert main(["plant", "--count", "3"]) == 0
    shown = capsys.readouterr()
    assert shown.out == "3\n"
    assert shown.err == "poet-loc: warning: the header was repaired\n"


def test_the_installed_program_exits_with_the_status():
    program = "import sys; from poet_loc.cli.main import main; sys.exit(main(['nonsense']))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
