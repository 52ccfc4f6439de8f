"""Ports, adapters and holders, read from made-up /dev, /sys and /proc trees."""

import os
from pathlib import Path

import pytest

from sfms_robot.servo.discovery import Holder, access_problem, describe, holders, list_ports


@pytest.fixture
def ftdi(tmp_path: Path) -> Path:
    """An FTDI adapter at ttyUSB0 and a bare port at ttyACM0, as Linux shows them."""
    dev, sys = tmp_path / "dev", tmp_path / "sys"
    (dev / "serial" / "by-id").mkdir(parents=True)
    for name in ("ttyUSB0", "ttyACM0", "tty7"):
        (dev / name).touch()
    (dev / "serial" / "by-id" / "usb-FTDI_U2D2_FT123-if00-port0").symlink_to("../../ttyUSB0")
    usb = sys / "devices" / "pci0" / "usb1" / "1-2"
    tty = usb / "1-2:1.0" / "ttyUSB0"
    tty.mkdir(parents=True)
    for name, text in {"idVendor": "0403", "idProduct": "6014", "serial": "FT123", "product": "U2D2"}.items():
        (usb / name).write_text(text + "\n")
    (sys / "class" / "tty" / "ttyUSB0").mkdir(parents=True)
    (sys / "class" / "tty" / "ttyUSB0" / "device").symlink_to(tty)
    driver = sys / "bus" / "usb-serial" / "drivers" / "ftdi_sio"
    driver.mkdir(parents=True)
    (tty / "driver").symlink_to(driver)
    timer = sys / "bus" / "usb-serial" / "devices" / "ttyUSB0" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    return tmp_path


def process(proc: Path, pid: int, command: str, *targets: str) -> None:
    (proc / str(pid) / "fd").mkdir(parents=True)
    (proc / str(pid) / "cmdline").write_bytes(command.replace(" ", "\0").encode() + b"\0")
    for number, target in enumerate(targets):
        (proc / str(pid) / "fd" / str(number)).symlink_to(target)


def test_an_adapter_tells_numbers_driver_and_latency(ftdi):
    usb, acm = sorted(list_ports(ftdi / "dev", ftdi / "sys"), key=lambda each: each.path, reverse=True)
    assert usb.path.endswith("ttyUSB0") and usb.by_id.endswith("usb-FTDI_U2D2_FT123-if00-port0")
    assert (usb.vendor, usb.product, usb.serial, usb.description) == ("0403", "6014", "FT123", "U2D2")
    assert usb.driver == "ftdi_sio" and usb.latency_ms == 16 and usb.latency_file.endswith("latency_timer")
    assert (acm.vendor, acm.latency_ms, acm.by_id) == (None, None, None)


def test_a_link_is_described_as_what_it_points_to(ftdi):
    link = ftdi / "dev" / "serial" / "by-id" / "usb-FTDI_U2D2_FT123-if00-port0"
    assert describe(str(link), ftdi / "dev", ftdi / "sys").path == str(ftdi / "dev" / "ttyUSB0")


def test_a_terminal_is_no_servo_port(ftdi):
    assert not any("tty7" in each.path for each in list_ports(ftdi / "dev", ftdi / "sys"))


def test_holders_are_found_through_links_and_named(ftdi):
    proc, port = ftdi / "proc", str(ftdi / "dev" / "ttyUSB0")
    process(proc, 100, "python wizard.py", "/dev/null", port)
    process(proc, 200, "bash", "/dev/null")
    process(proc, os.getpid(), "ourselves", port)
    (proc / "300").mkdir()  # its files may not be looked at
    link = str(ftdi / "dev" / "serial" / "by-id" / "usb-FTDI_U2D2_FT123-if00-port0")
    assert holders(link, proc) == [Holder(100, "python wizard.py")]


def test_a_port_that_this_process_holds_is_really_seen_in_proc():
    master, slave = os.openpty()
    try:
        assert holders(os.ttyname(slave)) == []  # held by ourselves only
        assert access_problem(os.ttyname(slave)) is None
    finally:
        os.close(master)
        os.close(slave)


def test_what_is_no_serial_port_is_told_apart(tmp_path):
    (tmp_path / "file").touch()
    assert "directory" in access_problem(str(tmp_path))
    assert "file" in access_problem(str(tmp_path / "file"))
    assert "no such device" in access_problem(str(tmp_path / "nothing"))
