"""The page of a leaderboard: one file that needs no network, with the style of score reports."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from robomme_interference_data.evaluate.score import report
from robomme_interference_data.storage.files import write_text
from robomme_interference_data.viz.tables import p_text, percent, points
from robomme_interference_data.viz.templates import fill

_WHAT = "the page of a leaderboard"

_TRAINED = {"interference": "yes", "other": "no", "nothing": "no", None: "unknown"}
"""The column that states what was trained on interference."""


def write_page(data: Mapping[str, Any], path: Path, opened_in: Path) -> None:
    """Write the page of `Leaderboard.to_dict`; its links are relative to the folder `opened_in`."""
    values = {
        "boards": [board | _groups(board) for board in data["boards"]],
        "refused": data["refused"],
        "rules": data["rules"],
        "style": _shared("_style.css.j2"),
        "tables_script": _shared("_tables.js.j2"),
        "outcomes": _safe_json([_outcomes(board) for board in data["boards"]]),
        "trained": _TRAINED,
    }
    filters = {
        "percent": percent,
        "points": points,
        "p": p_text,
        "href": lambda address: _href(address, opened_in),
        "pinned": lambda text: text.partition("@")[0],
    }
    html = fill(
        __package__, "leaderboard.html.j2", values, what=_WHAT, autoescape=True, filters=filters
    )
    write_text(path, html)


def _shared(name: str) -> str:
    """Return style or script of the score's report, which is the same here."""
    return fill(report.__name__, name, {}, what=_WHAT)


def _groups(board: Mapping[str, Any]) -> dict[str, Any]:
    """Return the systems and families that parts of a board show."""
    ran = [system for system in board["systems"] if board["ranked_by"] in system["success"]]
    systems = {system["system"]: system for system in board["systems"]}
    families = dict.fromkeys(name for system in ran for name in system["families"])
    return {
        "ran": ran,
        "lines": {
            control: systems[control]["success"][condition]["rate"]
            for control, condition in board["controls"].items()
        },
        "names": {name: system["name"] for name, system in systems.items()},
        "control_names": [systems[control]["name"] for control in board["controls"]],
        "compared": [system for system in ran if system["differences"]],
        "families": [*families],
        "others": [name for name in board["conditions"] if name != board["ranked_by"]],
    }


def _outcomes(board: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the picture of a board shows."""
    return {
        "id": board["board"],
        "episodes": board["episodes"],
        "systems": [
            {name: system[name] for name in ("system", "name", "standing", "outcomes")}
            for system in board["systems"]
        ],
    }


def _safe_json(value: Any) -> str:
    """Return JSON that is safe inside a script element."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _href(address: str, opened_in: Path) -> str:
    """Return an address as it is, and a path relative to where the page is."""
    if address.startswith(("http://", "https://")):
        return address
    return quote(os.path.relpath(address, opened_in))
