"""The noise of detections goes through a file: fit-noise writes it, fuse reads it."""

from __future__ import annotations

from test_main import one_line

from fusion.options import DetectionBias, DetectionNoise, FuseOptions
from poet_loc.cli.main import main
from poet_loc.cli.noise_file import noise_text, with_noise_from


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


def test_an_option_is_not_given_by_the_file_and_by_hand(clean_log, tmp_path, capsys):
    path = tmp_path / "noise.yaml"
    path.write_text(noise_text(DetectionNoise(), DetectionBias()))
    words = ["fuse", str(clean_log), "--out", str(tmp_path / "run"), "--no-pictures", "--noise-from", str(path)]
    assert main([*words, "--bias.no-use"]) == 1
    assert f"{path}: has bias.use, which the command line gives too" in one_line(capsys)
    assert main([*words, "--noise.rotation-deg", "5"]) == 1
    assert "noise.rotation-deg" in one_line(capsys)
    path.write_text("noise:\n  across: 0.01\n")
    assert main([*words, "--noise.rotation-deg", "5"]) == 0


def test_mean_errors_go_through_the_file(clean_log, tmp_path, capsys):
    path = tmp_path / "noise.yaml"
    means = ((1, 1.0, -2.0, 0.5, 0.01, 0.0, -0.03), (4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.02))
    path.write_text(noise_text(DetectionNoise(), DetectionBias(means=means)))
    assert with_noise_from(path, FuseOptions()) == FuseOptions(bias=DetectionBias(means=means))
    for wrong in ("3", "[[1, 2.0]]", "[[1.5, 0, 0, 0, 0, 0, 0]]", "[[1, 0, 0, 0, 0, 0, x]]"):
        path.write_text(f"bias:\n  means: {wrong}\n")
        assert main(["fuse", str(clean_log), "--out", str(tmp_path / "run"), "--noise-from", str(path)]) == 1
        assert f"{path}: means has" in one_line(capsys)
    path.write_text("bias:\n  means: [[1, 0, 0, 0, 0, 0, 0.9]]\n")
    assert main(["fuse", str(clean_log), "--out", str(tmp_path / "run"), "--noise-from", str(path)]) == 1
    assert f"{path}: bias.means" in one_line(capsys)


def test_a_table_of_fusions_takes_the_file(clean_log, tmp_path, capsys):
    path, rows = tmp_path / "noise.yaml", []
    path.write_text(noise_text(DetectionNoise(rotation_deg=20.0), DetectionBias(use=False)))
    words = ["table", str(clean_log), "--format", "csv", "--modes", "best"]
    for more in ([], ["--noise-from", str(path)]):
        assert main([*words, "--with-fusion", "--fusions", "eskf/objects", *more]) == 0
        rows.append([line for line in capsys.readouterr().out.splitlines() if "eskf/objects" in line])
    assert rows[0]
    assert rows[0] != rows[1]
    assert main([*words, "--noise-from", str(path)]) == 1
    assert "--noise-from changes nothing" in one_line(capsys)


def test_a_log_named_twice_is_refused(clean_log, capsys):
    assert main(["fit-noise", str(clean_log), str(clean_log / ".." / clean_log.name)]) == 1
    assert "is named twice" in one_line(capsys)
