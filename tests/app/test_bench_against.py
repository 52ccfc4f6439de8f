"""`bench NAME --against`: the other installation is that of the folder, or there is no figure."""

from pathlib import Path

import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.lab.bench.measure import environment


def test_a_folder_without_the_package_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"--against .*: no sfms_robot in it"):
        environment(tmp_path)


def test_a_folder_with_it_is_found_from_anywhere(tmp_path, monkeypatch):
    (tmp_path / "other" / "sfms_robot").mkdir(parents=True)
    (tmp_path / "other" / "sfms_robot" / "__init__.py").write_text("")
    monkeypatch.chdir(tmp_path)
    assert environment(Path("other"))["PYTHONPATH"] == str(tmp_path / "other")
