"""The noise of detections goes through a file: fit-noise writes it, fuse reads it."""

from __future__ import annotations

from test_main import one_line

from poet_loc.cli.main import main


def test_fit_noise_replaces_its_file_only_when_asked(clean_log, tmp_path, capsys):
    out = tmp_path / "noise.yaml"
    out.write_text("mine\n")
    assert main(["fit-noise", str(clean_log), "--out", str(out)]) == 1
    assert "--overwrite" in one_line(capsys)
    assert out.read_text() == "mine\n"
    assert main(["fit-noise", str(clean_log), "--out", str(out), "--overwrite"]) == 0
    assert out.read_text().startswith("noise:")


def test_an_impossible_number_in_the_file_is_told_with_the_file(clean_log, tmp_path, capsys):
    path = tmp_path / "noise.yaml"
    path.write_text("bias:\n  correlation_along_s: 0\n")
    assert main(["fuse", str(clean_log), "--out", str(tmp_path / "run"), "--noise-from", str(path)]) == 1
    assert f"{path}: bias.correlation-along-s is 0" in one_line(capsys)


def test_fuse_without_varying_biases(clean_log, tmp_path):
    none = [word for name in ("across", "along", "rotation-deg") for word in (f"--bias.{name}", "0")]
    assert main(["fuse", str(clean_log), "--out", str(tmp_path / "run"), "--no-pictures", *none]) == 0
