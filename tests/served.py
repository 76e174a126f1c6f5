"""One emulated device in a process of its own at real time, for clients that other people wrote."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from msgspec import to_builtins
from msgspec.structs import replace

from sim_device.plant.profile import Profile, load_profile

ROOT = Path(__file__).parents[1]


@contextlib.contextmanager
def served(folder: Path, which: str, kind: str, profile: Profile, *options: str) -> Iterator[str]:
    """Serve the gyro or the stage of a profile; yield its address without the driver's name."""
    file = folder / "profile.toml"
    file.write_text(_toml(to_builtins(profile)))
    command = [sys.executable, "-m", "sim_device", "--parent-death", f"--{which}", kind, "--only", which]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [*command, "--profile", str(file), "--seed", "1", *options], cwd=ROOT, stdin=pipe, stdout=pipe, text=True
    ) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())[which].removeprefix(f"{kind}:")
        finally:
            process.kill()


def near_home(*, power_up_deg: float = 2.0, brisk: bool = False) -> Profile:
    """Return an ideal bench switched on near its references, so that homing does not take long; `brisk` even less."""
    profile = load_profile("ideal")
    stage = profile.stage
    axes = {name: replace(getattr(stage, name), power_up_deg=power_up_deg) for name in ("azimuth", "elevation")}
    if brisk:
        axes |= {"max_acceleration_deg_per_s2": 60.0, "stop_deceleration_deg_per_s2": 600.0}
    return replace(profile, stage=replace(stage, **axes))


def _toml(table: dict[str, object], name: str = "") -> str:
    """Return a table as TOML: what stands in it first, then the tables within it."""
    lines = [f"[{name}]"] if name else []
    tables = []
    for key, value in table.items():
        if isinstance(value, dict):
            tables.append(_toml(value, f"{name}.{key}" if name else key))
        elif value is not None:
            lines.append(f"{key} = {json.dumps(value)}")
    return "\n".join([*lines, *tables])
