"""Motions in the browser, and as files to show around. Needs the extra `[viewer]`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import xarray as xr

from ssm_decouple.errors import InputError, as_items
from ssm_decouple.viewing.viewer.server import HOST, PORT, require_viser

if TYPE_CHECKING:
    from ssm_decouple.viewing.viewer.player import Player
    from ssm_decouple.viewing.viewer.scene import Scene

Motions = xr.Dataset | Sequence[xr.Dataset] | Mapping[str, xr.Dataset]


def view(
    motions: Motions,
    host: str = HOST,
    port: int = PORT,
    playing: bool = True,
    mesh_folders: Sequence[str | Path] = (),
) -> Player:
    """Show motions in the browser, side by side on one clock.

    The page is served until the player is stopped or the program ends, whether anybody looks or not: `player.wait()`
    keeps a script alive.

    Args:
        motions: One, several, or several by name; a name is what stands beside its spacecraft.
        host: Address to listen on; the loopback can be reached from this machine alone.
        port: Where the page is; the next free one if it is taken.
        playing: Whether it plays from the start.
        mesh_folders: Where the meshes of the URDF are looked for.

    Returns:
        The player: its `url`, `play()`, `pause()`, `seek(time)`, `wait()`, `stop()`.

    Raises:
        InputError: no motion, one that does not fit its robot, or viser is not installed.
    """
    require_viser()
    from ssm_decouple.viewing.viewer.player import Player

    return Player(scenes_of(motions, mesh_folders), host, port, playing)


def scenes_of(motions: Motions, mesh_folders: Sequence[str | Path] = ()) -> list[Scene]:
    """Return motions ready to be drawn.

    Raises:
        InputError: none, or one that does not fit its robot.
    """
    from ssm_decouple.viewing.viewer.scene import Scene

    if isinstance(motions, xr.Dataset):
        motions = [motions]
    mend = "give one or several motions, as simulate(..) returns them"
    named = motions.items() if isinstance(motions, Mapping) else enumerate(as_items("motions", motions, mend))
    pairs: list[tuple[object, xr.Dataset]] = list(named)  # type: ignore[arg-type]
    if not pairs:
        raise InputError("there is no motion to show; give one, as simulate(..) returns it")
    for _, motion in pairs:
        if not isinstance(motion, xr.Dataset):
            raise InputError(f"{type(motion).__name__} is no motion; give what simulate(..) or load_motion(..) returns")
    return [
        Scene.of(name if isinstance(name, str) else law_name(motion), motion, mesh_folders) for name, motion in pairs
    ]


def law_name(motion: xr.Dataset) -> str:
    """Return what a motion without a name is called: its law, by what it protects."""
    k, linear = motion.sizes["protected"], bool((motion.U_c.values[:3] != 0).any())
    if k == 0:
        return "none"
    damping = json.loads(motion.attrs.get("law", "{}")).get("damping", 1.0)
    return ("reactionless" if k == 3 and not linear else "selective") + ("" if damping else ", undamped")
