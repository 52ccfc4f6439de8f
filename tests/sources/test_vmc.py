"""Avatar software: OSC as python-osc writes it, names and presets, bones in our axes, and whatever else comes."""

import math
import socket
import struct

import numpy as np
import pytest
from free_ports import free_udp_port
from hypothesis import given
from hypothesis import strategies as st
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder
from scipy.spatial.transform import Rotation

from sfms_robot.errors import PacketError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, SHAPES
from sfms_robot.sources.vmc import VmcDecoder, elements, open_vmc, turn_of_unity

LEVEL = (0.0, 0.0, 0.0)
IDENTITY = (0.0, 0.0, 0.0, 1.0)
UNITY_TO_OURS = np.array([[0, 0, 1], [-1, 0, 0], [0, 1, 0]])  # x right, y up, z forward -> x forward, y left, z up


def message(address, *values):
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(*value) if isinstance(value, tuple) else builder.add_arg(value)
    return builder.build()


def bundle(*messages):
    builder = OscBundleBuilder(IMMEDIATELY)
    for each in messages:
        builder.add_content(each)
    return builder.build().dgram


def wrapped(data):
    return b"#bundle\0" + bytes(8) + struct.pack(">i", len(data)) + data


def blend(name, value):
    return message("/VMC/Ext/Blend/Val", name, value)


def bone(name, quaternion):
    return message("/VMC/Ext/Bone/Pos", name, *LEVEL, *map(float, quaternion))


APPLY = message("/VMC/Ext/Blend/Apply")


def shown(*messages, decoder=None):
    return (decoder or VmcDecoder()).decode(bundle(*messages), 0.0)


@pytest.mark.parametrize(
    "written", [str, str.upper, str.lower, lambda name: "BlendShape." + name.replace("Left", "_L")]
)
def test_every_arkit_name_in_any_case_and_spelling(written):
    values = np.linspace(0.1, 0.9, 52).astype(np.float32)
    motion = shown(
        *(blend(written(name), float(value)) for name, value in zip(BLENDSHAPES, values, strict=True)), APPLY
    )
    assert motion[SHAPES] == pytest.approx(values)


@pytest.mark.parametrize(
    ("preset", "moves"),
    [
        ("Blink_L", {"eyeBlinkLeft"}),
        ("blinkRight", {"eyeBlinkRight"}),
        ("A", {"jawOpen"}),
        ("ou", {"jawOpen", "mouthPucker"}),
        ("Joy", {"mouthSmileLeft", "mouthSmileRight", "cheekSquintLeft", "cheekSquintRight"}),
        ("lookLeft", {"eyeLookOutLeft", "eyeLookInRight"}),
        ("Neutral", set()),
    ],
)
def test_a_preset_moves_the_shapes_nearest_to_it(preset, moves):
    motion = shown(blend(preset, 1.0), APPLY)
    assert {name for name in BLENDSHAPES if motion[CHANNEL_INDEX[name]]} == moves


def test_presets_count_until_an_arkit_shape_moves_and_with_apply_bundles_of_one_face_are_one():
    decoder = VmcDecoder()
    motion = shown(*(blend(name, 0.0) for name in BLENDSHAPES), blend("Joy", 1.0), APPLY, decoder=decoder)
    assert motion[CHANNEL_INDEX["mouthSmileRight"]] == 1
    motion = shown(blend("mouthSmileLeft", 0.2), APPLY, decoder=decoder)
    assert motion[CHANNEL_INDEX["mouthSmileLeft"]] == pytest.approx(0.2)
    assert motion[CHANNEL_INDEX["mouthSmileRight"]] == 0
    decoder = VmcDecoder()
    shown(blend("jawOpen", 0.5), APPLY, decoder=decoder)
    assert shown(blend("jawOpen", 0.75), decoder=decoder) is None
    assert shown(blend("eyeBlinkLeft", 0.75), decoder=decoder) is None
    assert shown(APPLY, decoder=decoder)[CHANNEL_INDEX["jawOpen"]] == 0.75


def faces_of(rounds, pack, decoder=None):
    """The jaw of each face that comes out of rounds of blendshapes a 30th of a second apart, and what is due then."""
    decoder, jaws = decoder or VmcDecoder(), []
    for number, value in enumerate(rounds):
        values = [blend("jawOpen", value), blend("eyeBlinkLeft", 1.0 - value)]
        for data in [bundle(*values)] if pack else [each.dgram for each in values]:
            jaws += [decoder.decode(data, number / 30)]
    jaws += [decoder.due(number / 30 + 0.05), decoder.due(number / 30 + 0.11)]
    return [(jaw[CHANNEL_INDEX["jawOpen"]], jaw[CHANNEL_INDEX["eyeBlinkLeft"]]) for jaw in jaws if jaw is not None]


@pytest.mark.parametrize("pack", [True, False])
def test_without_apply_a_face_is_complete_when_the_next_begins_or_after_100_ms(pack):
    assert faces_of([0.25, 0.5, 0.75], pack) == [(0.25, 0.75), (0.5, 0.5), (0.75, 0.25)]


def test_what_a_sender_lacks_and_names_that_say_nothing_are_told():
    decoder = VmcDecoder()
    shown(message("/VMC/Ext/OK", 1), decoder=decoder)
    assert decoder.remark().startswith("neither blendshapes (/VMC/Ext/Blend/Val) nor the bone Head")
    shown(bone("Head", IDENTITY), decoder=decoder)
    assert decoder.remark().startswith("the head's pose and no blendshapes")
    decoder = VmcDecoder()
    assert shown(blend("Ahoge", 1.0), blend("Ahoge", 0.5), blend("Tail", 1.0), APPLY, decoder=decoder) is None
    assert decoder.statistics()["unknown_names"] == 2
    assert shown(blend("Joy", 1.0), APPLY, decoder=decoder) is not None
    assert decoder.remark() == "4 of 52 channels used; not known: Ahoge, Tail"


@given(st.integers(0, 2**32 - 1))
def test_any_rotation_turns_our_axes_as_it_turns_unitys(seed):
    """R_ours = A R A^T, A a reflection: it takes left-handed axes to right-handed ones."""
    turn = Rotation.random(random_state=np.random.RandomState(seed))
    assert turn_of_unity(turn.as_quat()) == pytest.approx(UNITY_TO_OURS @ turn.as_matrix() @ UNITY_TO_OURS.T, abs=1e-6)


def test_the_head_goes_with_its_neck():
    neck, head = Rotation.from_euler("xyz", [0.1, 0.3, -0.2]), Rotation.from_euler("xyz", [-0.2, 0.1, 0.3])
    apart = shown(bone("Neck", neck.as_quat()), bone("Head", head.as_quat()))
    whole = shown(bone("head", (neck * head).as_quat()), bone("Hips", head.as_quat()))
    assert apart[:3] == pytest.approx(whole[:3], abs=1e-6)


def test_lost_tracking_shows_nothing_until_it_is_back():
    decoder = VmcDecoder()
    assert shown(message("/VMC/Ext/OK", 1, 3, 0, 0), APPLY, decoder=decoder) is None
    assert shown(APPLY, decoder=decoder) is None
    assert shown(message("/VMC/Ext/OK", 1, 3, 0, 1), APPLY, decoder=decoder) is not None
    assert decoder.statistics()["lost_tracking"] == 1
    assert shown(message("/VMC/Ext/OK", 1), APPLY, decoder=decoder) is not None


@pytest.mark.parametrize("value", [1, (0.25, "d"), (1, "h")])
def test_numbers_of_other_types_are_read(value):
    turn = [(part, "d") for part in (*LEVEL, 0.0, math.sin(0.15), 0.0, math.cos(0.15))]
    motion = shown(blend("jawOpen", value), message("/VMC/Ext/Bone/Pos", "Head", *turn), APPLY)
    assert motion[CHANNEL_INDEX["jawOpen"]] == (value[0] if isinstance(value, tuple) else value)
    assert motion[:3] == pytest.approx([0, 0, -0.3], abs=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        message("/VMC/Ext/Blend/Val", 1.0, "jawOpen"),
        message("/VMC/Ext/Blend/Val", "jawOpen"),
        message("/VMC/Ext/Blend/Val", "jawOpen", "wide"),
        message("/VMC/Ext/Blend/Val", "jawOpen", True),
        message("/VMC/Ext/Blend/Val", "jawOpen", math.nan),
        message("/VMC/Ext/Blend/Val", "jawOpen", b"blob"),
        message("/VMC/Ext/Bone/Pos", "Head", 0.0, 0.0, 0.0),
        message("/VMC/Ext/Bone/Pos", "Head", "a", "b", "c", "d", "e", "f", "g"),
        bone("Head", (0, 0, 0, 0)),
        bone("Head", (math.nan, 0, 0, 1)),
        bone("Head", (0, 0, 0, 5)),
        message("/VMC/Ext/OK"),
    ],
)
def test_messages_of_wrong_types_are_counted_and_change_nothing(wrong):
    decoder = VmcDecoder()
    assert not shown(wrong, APPLY, decoder=decoder).any() and decoder.statistics()["wrong_messages"] == 1


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "no OSC"),
        (b"hello", "no OSC"),
        (b"#bundle\0" + bytes(8) + struct.pack(">i", -4), "cut off"),  # a size that goes nowhere
        (b"#bundle\0" + bytes(8) + struct.pack(">i", 0) * 3, "cut off"),
        (bundle(APPLY)[:-4], "cut off"),
        (bundle(*[APPLY] * 1100), "without end"),
        (message("/tuio/2Dcur", "alive").dgram, "VMC"),
        (message("/W", 3, 0.3).dgram, "Face Cap in live mode, which has no VMC: use Live Link Face"),
        (bundle(message("/HR", 1.0, 2.0, 3.0)), "Face Cap"),
        (message("/avatar/parameters/v2/JawOpen", 0.5).dgram, "VRCFaceTracking .* VRCFTtoVMCP"),
        (b"mouthSmile_R-42|jawOpen-12|=head#-21,-6,-6,-0,-0,-0|", "iFacialMocap.*switch on sending of VMC Protocol"),
        (b"mouthSmile_R&42|jawOpen&12|", "iFacialMocap"),
        (b"\x06\0\0\0\x24$0000" + bytes(300), "--face live-link takes it"),
        (b'{"FaceFound": true}', "JSON, which is not read here"),
    ],
)
def test_what_is_no_packet_is_refused(data, reason):
    with pytest.raises(PacketError, match=reason):
        VmcDecoder().decode(data, 0.0)


def test_bundles_in_bundles_end_somewhere():
    data = APPLY.dgram
    for depth in range(2000):
        data = wrapped(data)
        if depth == 2:
            assert list(elements(data)) == [APPLY.dgram]
    with pytest.raises(PacketError, match="without end"):
        list(elements(data))


def damaged(damage):
    """A frame with other bytes at some places."""
    data = bytearray(bundle(*(blend(name, 0.5) for name in BLENDSHAPES), bone("Head", IDENTITY), APPLY))
    for place, value in damage:
        data[place % len(data)] = value
    return bytes(data)


DAMAGE = st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=20)
HEADS = st.sampled_from([b"", b"/VMC/Ext/Blend/Val\0\0", b"/VMC/Ext/Bone/Pos\0\0\0,sfffffff\0\0\0"])
BYTES = st.builds(bytes.__add__, HEADS, st.binary(max_size=300))


@given(BYTES | BYTES.map(wrapped) | st.builds(damaged, DAMAGE))
def test_any_bytes_are_refused_or_finite(data):
    try:
        motion = VmcDecoder().decode(data, 0.0)
    except PacketError:
        return
    assert motion is None or np.isfinite(motion).all()


@pytest.fixture
def sight():
    opened = open_vmc(str(free_udp_port()))
    opened.start(0.0)
    yield opened
    opened.close()


def test_avatar_software_on_this_machine_is_seen(sight):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(bundle(blend("jawOpen", 0.0), APPLY), sight.address)
    while not sight.statistics()["packets"]:
        sight.at(1e9)
    for later_s, jaw in ((1.0, 0.0), (0.1, 0.5)):
        sight.feed(bundle(blend("jawOpen", jaw), APPLY), sight._sender, sight._heard_s + later_s)
        seen = sight.at(1e9)
    assert seen.face.blendshapes[BLENDSHAPES.index("jawOpen")] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("apply", [[APPLY], []])
def test_percent_and_a_new_port_for_each_packet_are_taken_and_the_units_said_once(sight, apply, caplog):
    for number in range(90):
        data = bundle(blend("jawOpen", 50.0 + 50.0 * math.sin(number / 5)), *apply)
        sight.feed(data, ("192.0.2.1", 1000 + number), number / 30)
        sight.at(number / 30)
        assert not sight.lost
    assert 58 <= sight.statistics()["faces"] <= 60 and sight.statistics()["refused"] == 0
    assert sight.at(3.0).face.blendshapes.max() <= 1.0
    assert sum("blendshapes are taken as percent" in record.message for record in caplog.records) == 1


@pytest.mark.parametrize(("values", "lost"), [((1,), True), ((1, 3, 0, 0), False)], ids=["no face", "nobody there"])
def test_packets_without_a_face_are_a_loss_with_its_reason_unless_the_sender_has_lost_its_person(
    sight, caplog, values, lost
):
    for number in range(90):
        sight.feed(bundle(message("/VMC/Ext/OK", *values)), ("192.0.2.1", 1), number / 30)
        sight.at(number / 30)
    assert sight.lost == lost and sum("neither blendshapes" in record.message for record in caplog.records) == lost
