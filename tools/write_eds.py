"""Write the electronic data sheets of the CANopen nodes, ``drivers/eds/*.eds``, from their object dictionaries.

Run after any change of the dictionaries; a test holds both together.
"""

from __future__ import annotations

from pathlib import Path

from sim_device.data_sheets import SHEETS, data_sheet

FOLDER = Path(__file__).parents[1] / "drivers" / "eds"


def main() -> None:
    """Write all sheets."""
    FOLDER.mkdir(exist_ok=True)
    for file in SHEETS:
        (FOLDER / file).write_text(data_sheet(file), encoding="ascii", newline="\n")
        print(FOLDER / file)


if __name__ == "__main__":
    main()
