"""docs/record.md describes the schema as it is."""

from pathlib import Path

from northfinder.record.schema import SCHEMA_VERSION, TABLES

PAGE = (Path(__file__).parents[1] / "docs" / "record.md").read_text()


def test_every_column_is_described_with_its_unit() -> None:
    """Each table's columns in their order, each with kind and unit, and no others."""
    assert f"schema version {SCHEMA_VERSION} " in PAGE
    for table, columns in TABLES.items():
        section = PAGE.split(f"**{table}**", 1)[1].split("**", 1)[0].split("## ", 1)[0]
        lines = [[cell.strip() for cell in line.split("|")] for line in section.splitlines() if line.startswith("| ")]
        described = [(name, kind, unit) for _, name, kind, unit, *_ in lines[1:]]
        assert described == [(column.name, column.kind, column.unit) for column in columns]
