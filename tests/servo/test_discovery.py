"""Ports, adapters and holders, read from made-up /dev, /sys and /proc trees; the text of --port."""

import os
from dataclasses import dataclass
from pathlib import Path

import pytest

from sfms_robot.errors import ConfigError, PortError
from sfms_robot.servo import discovery


@dataclass
class Listed:
    """An entry of pyserial's list."""

    device: str
    vid: int | None = None
    pid: int | None = None
    serial_number: str | None = None
    description: str | None = "n/a"
    product: str | None = None
    location: str | None = None


@pytest.fixture
def ftdi(tmp_path: Path) -> Path:
    """An FTDI adapter at ttyUSB0 and a bare port at ttyACM0, as Linux shows them."""
    dev, sys = tmp_path / "dev", tmp_path / "sys"
    (dev / "serial" / "by-id").mkdir(parents=True)
    for name in ("ttyUSB0", "ttyACM0", "tty7"):
        (dev / name).touch()
    (dev / "serial" / "by-id" / "usb-FTDI_U2D2_FT123-if00-port0").symlink_to("../../ttyUSB0")
    driver, tty = sys / "bus" / "usb-serial" / "drivers" / "ftdi_sio", sys / "class" / "tty" / "ttyUSB0" / "device"
    driver.mkdir(parents=True)
    tty.mkdir(parents=True)
    (tty / "driver").symlink_to(driver)
    timer = sys / "bus" / "usb-serial" / "devices" / "ttyUSB0" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    return tmp_path


def listed(root: Path, *more: Listed):
    """Return pyserial's list of these ports and the FTDI adapter."""
    u2d2 = Listed(str(root / "dev" / "ttyUSB0"), 0x0403, 0x6014, "FT123", "U2D2 - U2D2", "U2D2", "1-2")
    return lambda: [u2d2, *more]


def process(proc: Path, pid: int, command: str, *targets: str) -> None:
    (proc / str(pid) / "fd").mkdir(parents=True)
    (proc / str(pid) / "cmdline").write_bytes(command.replace(" ", "\0").encode() + b"\0")
    for number, target in enumerate(targets):
        (proc / str(pid) / "fd" / str(number)).symlink_to(target)


def test_an_adapter_is_described_by_numbers_driver_and_latency_also_through_a_link(ftdi):
    (ftdi / "dev" / "serial0").symlink_to("ttyAMA0")
    for name, kind in {"ttyS0": "0", "ttyS4": "4", "ttyAMA0": "4"}.items():  # PORT_UNKNOWN: no hardware
        (ftdi / "dev" / name).touch()
        (ftdi / "sys" / "class" / "tty" / name).mkdir(parents=True)
        (ftdi / "sys" / "class" / "tty" / name / "type").write_text(kind + "\n")
    more = listed(
        ftdi,
        Listed("/dev/COM3", 0x0403, 0x6014, "FT9", "USB Serial Port (COM3)"),
        Listed("/dev/cu.usbserial-FT9", 0x0403, 0x6014, "FT9"),
        Listed(str(ftdi / "dev" / "ttyS0")),
    )
    places = ftdi, more
    found = {os.path.basename(each.path): each for each in discovery.list_ports(*places)}
    assert sorted(found) == ["COM3", "cu.usbserial-FT9", "ttyACM0", "ttyAMA0", "ttyS4", "ttyUSB0"]
    usb, acm, com = found["ttyUSB0"], found["ttyACM0"], found["COM3"]
    assert usb.by_id == str(ftdi / "dev" / "serial" / "by-id" / "usb-FTDI_U2D2_FT123-if00-port0")
    assert (usb.vendor, usb.product, usb.serial, usb.description) == ("0403", "6014", "FT123", "U2D2")
    assert usb.driver == "ftdi_sio" and usb.latency_ms == 16 and usb.latency_file.endswith("latency_timer")
    assert (acm.vendor, acm.latency_ms, acm.by_id) == (None, None, None)
    assert (com.vendor, com.serial, com.description) == ("0403", "FT9", "USB Serial Port (COM3)")
    assert found["cu.usbserial-FT9"].description is None
    assert discovery.describe(usb.by_id, *places) == usb


def test_holders_are_found_through_links_and_named(ftdi):
    proc, port = ftdi / "proc", str(ftdi / "dev" / "ttyUSB0")
    process(proc, 100, "python wizard.py", "/dev/null", port)
    process(proc, 200, "bash", "/dev/null")
    process(proc, os.getpid(), "ourselves", port)
    (proc / "300").mkdir()  # its files may not be looked at
    link = str(ftdi / "dev" / "serial" / "by-id" / "usb-FTDI_U2D2_FT123-if00-port0")
    assert discovery.holders(link, ftdi) == [discovery.Holder(100, "python wizard.py")]


def test_what_is_no_serial_port_is_told_apart(tmp_path):
    (tmp_path / "file").touch()
    assert "directory" in discovery.access_problem(str(tmp_path))
    assert "file" in discovery.access_problem(str(tmp_path / "file"))
    assert "no such device" in discovery.access_problem(str(tmp_path / "nothing"))
    for device, meant in (
        ("192.168.1.5:4000", "is written socket://192.168.1.5:4000"),
        ("null", "is written /dev/null"),
        ("COM12", "are Windows'"),
    ):
        with pytest.raises(PortError, match=rf"^{device}: no such device; .*{meant} \(serial ports here: .+\)$"):
            discovery.check_device(device)


def test_what_else_takes_a_port_is_named_with_the_command_that_frees_it(tmp_path):
    proc, active = tmp_path / "proc", tmp_path / "sys" / "class" / "tty" / "console" / "active"
    active.parent.mkdir(parents=True)
    active.write_text("tty0 ttyAMA0\n")
    for pid, name, line in (
        (7, "agetty", "/sbin/agetty --keep-baud ttyAMA0 vt220"),
        (8, "ModemManager", "/usr/sbin/ModemManager"),
        (9, "brltty", "/usr/bin/brltty --no-daemon"),
    ):
        (proc / str(pid)).mkdir(parents=True)
        (proc / str(pid) / "comm").write_text(f"{name}\n")
        (proc / str(pid) / "cmdline").write_bytes(line.replace(" ", "\0").encode())
    told = {path: discovery.rivals(path, tmp_path) for path in ("/dev/ttyAMA0", "/dev/ttyUSB3", "/dev/ttyS1")}
    (console, _), (getty, disable) = told["/dev/ttyAMA0"]
    assert "login console" in console and "process 7" in getty
    assert disable == "sudo systemctl disable --now serial-getty@ttyAMA0"
    assert [(words.split()[0], fix) for words, fix in told["/dev/ttyUSB3"]] == [
        ("ModemManager", "sudo systemctl mask --now ModemManager"),
        ("brltty", "sudo systemctl mask --now brltty"),
    ]
    assert told["/dev/ttyS1"] == []


def plug(root: Path, tty: str, socket: str, serial: str | None, by_id: str) -> Listed:
    """A USB adapter at `tty`, plugged into `socket`; the link by-id goes to the last one, as udev leaves it."""
    dev = root / "dev"
    for folder, name in (("by-id", by_id), ("by-path", f"pci-usb-{socket}-port0")):
        (dev / "serial" / folder).mkdir(parents=True, exist_ok=True)
        (dev / "serial" / folder / name).unlink(missing_ok=True)
        (dev / "serial" / folder / name).symlink_to(f"../../{tty}")
    (dev / tty).touch()
    return Listed(str(dev / tty), 0x1A86, 0x7523, serial, product="USB Serial", location=f"{socket}:1.0")


def names(root: Path, ports: list[Listed], *devices: str) -> list[str]:
    devices = devices or tuple(port.device for port in ports)
    return [os.path.basename(discovery.stable_name(device, root, lambda: ports)) for device in devices]


@pytest.mark.parametrize("serial", [None, "0001"])
def test_two_adapters_with_equal_numbers_are_named_by_their_sockets(tmp_path, serial):
    ports = [plug(tmp_path, f"ttyUSB{i}", f"1-{i}", serial, "usb-1a86_USB_Serial-if00-port0") for i in (1, 2)]
    assert names(tmp_path, ports) == ["pci-usb-1-1-port0", "pci-usb-1-2-port0"]
    link = str(tmp_path / "dev" / "serial" / "by-id" / "usb-1a86_USB_Serial-if00-port0")
    assert names(tmp_path, ports, link) == ["pci-usb-1-2-port0"]  # what it means now, not after the next power cycle


def test_an_adapter_with_a_serial_number_of_its_own_may_move_to_another_socket(tmp_path):
    ports = [plug(tmp_path, f"ttyUSB{i}", f"1-{i}", f"A{i}", f"usb-1a86_A{i}-if00-port0") for i in (1, 2)]
    ports.append(plug(tmp_path, "ttyUSB3", "1-1", "A1", "usb-1a86_A1-if01-port0"))  # its second port
    assert names(tmp_path, ports)[:2] == ["usb-1a86_A1-if00-port0", "usb-1a86_A2-if00-port0"]


def test_without_a_lasting_name_the_device_stays(tmp_path):
    (tmp_path / "dev").mkdir()
    devices = str(tmp_path / "dev" / "ttyS1"), "socket://robot:4000", "COM3"
    assert names(tmp_path, [], *devices) == ["ttyS1", "robot:4000", "COM3"]


USB0, USB1 = (discovery.SerialDevice(f"/dev/ttyUSB{n}", vendor=vendor) for n, vendor in enumerate(("0403", "1a86")))
BUILT_IN = discovery.SerialDevice("/dev/ttyS0")


@pytest.mark.parametrize(
    ("buses", "text", "devices"),
    [
        (["main"], "/dev/ttyUSB0", {"main": "/dev/ttyUSB0"}),
        (["main"], "main=/dev/ttyUSB0", {"main": "/dev/ttyUSB0"}),
        (["main"], "socket://robot:4000?a=b", {"main": "socket://robot:4000?a=b"}),
        (["neck", "face"], "face=COM4,neck=COM3", {"neck": "COM3", "face": "COM4"}),
    ],
)
def test_every_bus_gets_its_device(buses, text, devices):
    assert discovery.parse_ports(buses, text) == devices


@pytest.mark.parametrize(
    ("buses", "text", "problem"),
    [
        (["main"], "main=A,main=B", "bus main is given twice"),
        (["main"], "foo=/dev/ttyS0", "one device per bus is needed"),
        (["main"], "main=", "one device per bus is needed"),
        (["main"], "A,B", "one device per bus is needed"),
        (["neck", "face"], "/dev/ttyUSB0", "one device per bus is needed"),
        (["neck", "face"], "neck=A", "bus face has no device"),
        (["neck", "face"], "neck=A,face=A", "A is given to two buses"),
        (["neck", "face"], "neck=A,face=B,neck=C", "bus neck is given twice"),
    ],
)
def test_what_leaves_a_bus_in_doubt_is_refused(buses, text, problem):
    with pytest.raises(ConfigError, match=rf"^--port {text!r}: {problem} \(sim, auto, .*DEVICE\)$"):
        discovery.parse_ports(buses, text)


def test_auto_takes_the_one_adapter_and_does_not_guess_between_two():
    assert discovery.choose_ports(["main"], [BUILT_IN, USB0]) == {"main": "/dev/ttyUSB0"}
    with pytest.raises(PortError, match="no USB serial adapter is plugged in"):
        discovery.choose_ports(["main"], [BUILT_IN])
    with pytest.raises(ConfigError, match="2 adapters may be bus main .*/dev/ttyUSB0, /dev/ttyUSB1"):
        discovery.choose_ports(["main"], [USB0, USB1])
    with pytest.raises(ConfigError, match="auto: .* bus neck or face"):
        discovery.choose_ports(["neck", "face"], [USB0])
