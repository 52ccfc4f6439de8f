"""Kinds of listeners: ours, those of other packages, and those that are not there."""

import pytest

from sfms_robot.config import Listener
from sfms_robot.config.listener_kinds import LISTENER_KINDS, ListenerKind, listener_kind, parse_listener
from sfms_robot.errors import ConfigError


class Nodder(Listener):
    """Somebody's own settings."""

    kind: str = "nodder"
    nods_per_minute: float


def load(folder):
    return ("loaded", folder)


class Entry:
    """The part of importlib's EntryPoint that is used."""

    def __init__(self, name, loaded):
        self.name, self.value, self.loaded = name, f"theirs:{name}", loaded

    def load(self):
        if isinstance(self.loaded, Exception):
            raise self.loaded
        return self.loaded


OTHERS = [
    Entry("nodder", ListenerKind(f"{__name__}:Nodder", f"{__name__}:load")),
    Entry("broken", ImportError("no module named theirs")),
    Entry("wrong", "a text"),
    Entry("sfms", "an impostor"),
]


def test_a_kind_of_another_package_is_parsed_and_loaded_by_its_own():
    settings = parse_listener({"kind": "nodder", "nods_per_minute": 6}, "config.yaml", OTHERS)
    assert isinstance(settings, Nodder) and settings.nods_per_minute == 6
    assert listener_kind("nodder", "config.yaml", OTHERS).load_folder("folder") == ("loaded", "folder")
    with pytest.raises(ConfigError, match="config.yaml: nods_per_minute"):
        parse_listener({"kind": "nodder"}, "config.yaml", OTHERS)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("nobody", r"kind = 'nobody' is not a kind of listener \(sfms, arig, nodder, broken, wrong, sfms\)"),
        ("broken", "kind = 'broken' cannot be imported from theirs:broken: no module named theirs"),
        ("wrong", "kind = 'wrong' of theirs:wrong is no ListenerKind"),
    ],
)
def test_a_kind_that_is_not_there_or_not_right_is_one_line(name, told):
    with pytest.raises(ConfigError, match=f"^config.yaml: {told}"):
        listener_kind(name, "config.yaml", OTHERS)


def test_ours_are_not_replaced():
    assert listener_kind("sfms", "config.yaml", OTHERS) is LISTENER_KINDS["sfms"]


@pytest.mark.parametrize("name", LISTENER_KINDS)
def test_our_settings_say_their_own_kind(name):
    assert LISTENER_KINDS[name].settings_class().model_fields["kind"].annotation.__args__ == (name,)
