"""Where a benchmark ran, and how much memory its processes took."""

import os
import platform
from pathlib import Path


def describe_machine() -> str:
    """Return the processor, the cores this process may use, memory, and system, in words."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    memory = _field(Path("/proc/meminfo"), "MemTotal")
    size = f", {int(memory.split()[0]) / 2**20:.0f} GiB" if memory else ""
    processor = _field(Path("/proc/cpuinfo"), "model name") or platform.processor() or platform.machine()
    return f"{processor}, {cores} cores{size}, {platform.system()}, Python {platform.python_version()}"


def peak_bytes() -> int:
    """Return the most memory that this process has held, without what it was forked from (Linux only)."""
    return int(_field(Path("/proc/self/status"), "VmHWM").split()[0]) * 1024


def _field(file: Path, name: str) -> str:
    """Return what stands behind ``name:`` in a file of the kernel, empty if nothing does."""
    try:
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")
