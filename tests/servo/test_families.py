"""The one table of bus families: names, what they drive, and families of other packages."""

import importlib
import re

import pytest

from sfms_robot.config.joint import BUS_FAMILIES, BUS_GROUP
from sfms_robot.errors import ConfigError
from sfms_robot.servo.families import BusFamily, families, family_named, servo_families


def test_every_family_names_classes_that_there_are():
    assert set(families()) >= {"dynamixel2", "dynamixel1", "feetech", "maestro", "ssc32"}
    for family in families().values():
        assert isinstance(family.build(), type)
    for family in servo_families().values():
        assert isinstance(family.link_class(), type) and family.bauds and family.protocol in (1, 2)


def test_a_family_that_cannot_be_had_is_one_line():
    with pytest.raises(ConfigError, match="herkulex.*is unknown.*dynamixel2.*ssc32"):
        family_named("herkulex")
    with pytest.raises(ConfigError, match="Maestro: a board has no registers"):
        family_named("maestro").link_class()
    for bus in ("sfms_nowhere:Bus", "math:sqrt"):
        with pytest.raises(ConfigError, match=f"plug-in Theirs .*{bus}.*Error: "):
            BusFamily("Theirs", bus, ("theirs", None)).build("not a number")


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Another package in the path, with an entry point."""

    def install(line):
        info = tmp_path / "sfms_herkulex-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: sfms-herkulex\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{BUS_GROUP}]\n{line}\n")
        (tmp_path / "sfms_herkulex.py").write_text(
            "from sfms_robot.servo.families import BusFamily\n"
            "FAMILY = BusFamily('HerkuleX', 'collections:OrderedDict', ('herkulex', None))\n"
        )
        monkeypatch.syspath_prepend(str(tmp_path))
        importlib.invalidate_caches()
        families.cache_clear()

    yield install
    families.cache_clear()


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("feetech = sfms_herkulex:FAMILY", "expected a name that no family of sfms-robot has"),
        ("other = sfms_herkulex:BusFamily", "expected a BusFamily, got type"),
        ("other = sfms_herkulex:Missing", "AttributeError: .*no attribute 'Missing'"),
        ("other = sfms_raises:FAMILY", "RuntimeError: two"),
        ("other = sfms_exits:FAMILY", "SystemExit: 3"),
    ],
)
def test_a_plug_in_that_fails_is_named_once_and_left_out(installed, tmp_path, caplog, line, problem):
    (tmp_path / "sfms_raises.py").write_text("raise RuntimeError('two\\nlines')")
    (tmp_path / "sfms_exits.py").write_text("raise SystemExit(3)")
    installed(line)
    assert families() is families() and set(families()) == set(BUS_FAMILIES)
    (warning,) = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    assert re.fullmatch(f"plug-in .*package sfms-herkulex, .*: {problem}; it is left out", warning)
    if line.startswith("other"):  # for the user who names it, its error is the error
        with pytest.raises(ConfigError, match=f"^plug-in other .*{problem}$"):
            family_named("other")
