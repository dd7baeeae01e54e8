"""What the doctor can ask of this computer. ``root`` is where its file system begins; the rest are answers or askers."""

from __future__ import annotations

import ctypes.util
import json
import os
import resource
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any


def link(name: str) -> dict[str, Any] | None:
    """What ``ip`` knows of a network interface, its addresses included; None: there is none."""
    try:
        asked = ["ip", "-details", "-json", "address", "show", "dev", name]
        said = subprocess.run(asked, capture_output=True, text=True, check=True, timeout=5).stdout
        found = [entry for entry in json.loads(said) if entry.get("ifname") == name]
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
    return found[0] if found else None


def version(distribution: str) -> str:
    """The installed version; "": not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


@dataclass(frozen=True)
class Machine:
    """This computer, unless a test says otherwise."""

    root: Path = Path("/")
    link: Callable[[str], dict[str, Any] | None] = link
    version: Callable[[str], str] = version
    library: Callable[[str], str | None] = ctypes.util.find_library
    uid: int = field(default_factory=os.geteuid)
    rtprio: int = field(default_factory=lambda: resource.getrlimit(resource.RLIMIT_RTPRIO)[1])  # -1: no limit
    memlock: int = field(default_factory=lambda: resource.getrlimit(resource.RLIMIT_MEMLOCK)[1])  # bytes; -1: no limit
    cores: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))
    free: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free  # bytes

    def path(self, absolute: str) -> Path:
        return self.root / absolute.lstrip("/")

    def read(self, absolute: str) -> str | None:
        """A small file's text, stripped; None where there is none, or none may read it."""
        try:
            return self.path(absolute).read_text().strip()
        except OSError:
            return None

    def writable(self, absolute: str) -> bool:
        return os.access(self.path(absolute), os.R_OK | os.W_OK)
