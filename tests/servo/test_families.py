"""The one table of bus families: names, what they drive, and families of other packages."""

import importlib

import pytest

from sfms_robot.config import load_head
from sfms_robot.config.named_bus import BUS_GROUP
from sfms_robot.data import head_names
from sfms_robot.errors import ConfigError
from sfms_robot.servo.families import BusFamily, families, family_named, servo_families


def test_every_family_names_classes_that_there_are():
    assert set(families()) >= {"dynamixel2", "dynamixel1", "feetech", "maestro", "ssc32"}
    for family in families().values():
        assert isinstance(family.bus_class(), type)
    for family in servo_families().values():
        assert isinstance(family.link_class(), type) and family.bauds and family.protocol in (1, 2)


def test_every_bus_of_a_shipped_head_has_a_family():
    for name in head_names():
        for bus in load_head(name).buses.values():
            family_named(bus.family)


def test_name_of_an_older_head_means_dynamixel2():
    assert family_named("dynamixel") is family_named("dynamixel2")


def test_unknown_family_is_refused_with_those_there_are():
    with pytest.raises(ConfigError, match="herkulex.*is unknown.*dynamixel2.*ssc32"):
        family_named("herkulex")


def test_board_has_no_registers_to_speak_of():
    with pytest.raises(ConfigError, match="Maestro: a board has no registers"):
        family_named("maestro").link_class()


HERKULEX = BusFamily("HerkuleX", "collections:OrderedDict", ("herkulex", None))


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


def test_family_of_another_package_is_there_by_its_name(installed):
    installed("herkulex = sfms_herkulex:FAMILY")
    assert family_named("herkulex") == HERKULEX


@pytest.mark.parametrize("line", ["feetech = sfms_herkulex:FAMILY", "other = sfms_herkulex:BusFamily"])
def test_entry_point_that_is_no_family_or_takes_a_name_is_refused(installed, line):
    installed(line)
    with pytest.raises(ConfigError, match="entry point sfms_robot.buses"):
        families()
