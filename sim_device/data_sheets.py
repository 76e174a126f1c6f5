"""The electronic data sheets (CiA 306-1) of the CANopen nodes, made from their object dictionaries.

``tools/write_eds.py`` writes them to where the host's side ships them.
"""

from __future__ import annotations

from typing import Any

from sim_device.firmware import drive_objects, gyro_objects
from sim_device.firmware.objects import GROUPS

MANDATORY = (0x1000, 0x1001, 0x1018)
VARIABLE = 7

Entry = tuple[Any, ...]


def _sheet(file: str, product: str, product_code: int, objects: list[Entry]) -> str:
    """Return the text of a data sheet (CiA 306-1)."""
    indices = sorted({entry[0] for entry in objects})
    lines = [
        "[FileInfo]", f"FileName={file}", "FileVersion=1", "FileRevision=0", "EDSVersion=4.0",
        f"Description={product}", "CreatedBy=northfinder", "",
        "[DeviceInfo]", "VendorName=northfinder", "VendorNumber=0", f"ProductName={product}",
        f"ProductNumber={product_code}", "RevisionNumber=0x00010000", "OrderCode=",
        *(f"BaudRate_{rate}={int(rate >= 125)}" for rate in (10, 20, 50, 125, 250, 500, 800, 1000)),
        "SimpleBootUpMaster=0", "SimpleBootUpSlave=1", "Granularity=8", "DynamicChannelsSupported=0",
        "CompactPDO=0", "GroupMessaging=0",
        f"NrOfRXPDO={sum(0x1400 <= index < 0x1600 for index in indices)}",
        f"NrOfTXPDO={sum(0x1800 <= index < 0x1A00 for index in indices)}", "LSS_Supported=0", "",
        "[DummyUsage]", *(f"Dummy{number:04d}=0" for number in range(1, 8)), "",
        "[Comments]", "Lines=1", "Line1=Units and meaning of each object: docs/canopen.md", "",
    ]  # fmt: skip
    lists = {
        "MandatoryObjects": [index for index in indices if index in MANDATORY],
        "OptionalObjects": [index for index in indices if index not in MANDATORY and not 0x2000 <= index < 0x6000],
        "ManufacturerObjects": [index for index in indices if 0x2000 <= index < 0x6000],
    }
    for name, members in lists.items():
        numbered = [f"{number}=0x{index:04X}" for number, index in enumerate(members, 1)]
        lines += [f"[{name}]", f"SupportedObjects={len(members)}", *numbered, ""]
        for index in members:
            lines += _object(index, sorted(entry for entry in objects if entry[0] == index))
    return "\n".join(lines)


def _object(index: int, entries: list[Entry]) -> list[str]:
    if index not in GROUPS:
        return [f"[{index:04X}]", *_variable(entries[0]), ""]
    kind, name = GROUPS[index]
    lines = [f"[{index:04X}]", f"ParameterName={name}", f"ObjectType=0x{kind:X}", f"SubNumber={len(entries)}", ""]
    for entry in entries:
        lines += [f"[{index:04X}sub{entry[1]:X}]", *_variable(entry), ""]
    return lines


def _variable(entry: Entry) -> list[str]:
    _, _, kind, access, default, limits, mappable, name = entry
    lines = [f"ParameterName={name}", f"ObjectType=0x{VARIABLE:X}", f"DataType=0x{kind:04X}", f"AccessType={access}"]
    if limits is not None:
        lines += [f"LowLimit={limits[0]}", f"HighLimit={limits[1]}"]
    if default is not None:
        lines.append(f"DefaultValue={_default(default)}")
    return [*lines, f"PDOMapping={int(mappable)}"]


def _default(default: int | str | tuple[int]) -> str:
    if isinstance(default, tuple):
        return f"$NODEID+0x{default[0]:X}"
    if isinstance(default, str):
        return default
    return str(default) if abs(default) < 2**16 else f"0x{default:X}"


SHEETS = {
    "gyro.eds": ("northfinder gyro", gyro_objects.PRODUCT_CODE, gyro_objects.OBJECTS),
    "cia402_stage.eds": ("northfinder stage axis", drive_objects.PRODUCT_CODE, drive_objects.OBJECTS),
}


def data_sheet(file: str) -> str:
    """Return the data sheet of that file name."""
    return _sheet(file, *SHEETS[file])
