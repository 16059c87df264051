"""The machine: what it is, how busy others keep it, what this process takes of it."""

from __future__ import annotations

import datetime
import os
import platform
import resource
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple


def facts() -> dict[str, Any]:
    """Processor, cores, memory (GiB), system, Python, day."""
    name, memory = platform.processor() or platform.machine(), None
    vectors = []
    if Path("/proc/cpuinfo").exists():
        pairs = [line.split(":", 1) for line in Path("/proc/cpuinfo").read_text().splitlines() if ":" in line]
        lines = {key.strip(): value.strip() for key, value in pairs}
        family = f"family {lines.get('cpu family', '?')} model {lines.get('model', '?')}"
        name = f"{lines.get('model name', name)} ({family})"
        vectors = [flag for flag in ("avx2", "fma", "avx512f") if flag in lines.get("flags", "").split()]
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30)
    return {
        "processor": name,
        "vectors": vectors,
        "cores": os.cpu_count(),
        "memory": memory,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "day": datetime.date.today().isoformat(),
    }


def peak_memory() -> float:
    """MiB that this process has held at most."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


class Use(NamedTuple):
    """Seconds of processors so far, of the whole machine (0 where nobody tells) and of this process; and the clock."""

    machine: float
    own: float
    clock: float

    @classmethod
    def now(cls) -> Use:
        own = resource.getrusage(resource.RUSAGE_SELF)
        return cls(_busy(), own.ru_utime + own.ru_stime, time.perf_counter())

    def others(self) -> float:
        """Cores that others have taken since, the hypervisor among them; ticks are of 10 ms."""
        now = Use.now()
        return max(0.0, now.machine - self.machine - (now.own - self.own)) / max(now.clock - self.clock, 1e-9)

    def cores(self) -> float:
        """That this process has taken since."""
        now = Use.now()
        return (now.own - self.own) / max(now.clock - self.clock, 1e-9)


def _busy() -> float:
    path = Path("/proc/stat")
    if not path.exists():
        return 0.0
    user, nice, system, _, _, irq, softirq, steal = map(int, path.read_text().split()[1:9])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def wait_until_quiet(seconds: float, cores: float = 0.15) -> None:
    """Until others use fewer cores than this, but no longer than that."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        before = Use.now()
        time.sleep(0.5)
        if before.others() <= cores:
            return
