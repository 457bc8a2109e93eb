"""Drives of a batch as processes, and how each ended."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from erfsfm.common.progress import Progress
from slam.commands.batch.cluster import Spread
from slam.commands.batch.manifest import Drive
from slam.results.folder import RunFolder
from slam.runtime.errors import SlamError

Status = Literal["whole", "kept", "failed"]
_POLL_S = 0.5
_GIB = 2**30
_MOST_STDERR = 20_000
LOG_BEGIN = "erfsfm-slam run "  # a log begins with the command


@dataclass(frozen=True)
class Limits:
    """Of one drive's process: threads of libraries (0: as they like) and memory in GiB (0: no limit)."""

    threads: int = 0
    memory_gib: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """How a drive ended: its run is whole, or was whole before and kept, or failed with a reason."""

    drive: Drive
    folder: Path
    status: Status
    reason: str = ""


def run_drives(drives: list[Drive], output: Path, limits: Limits, spread: Spread, progress: Progress) -> list[Outcome]:
    """Run the drives that are not whole in ``output``; one outcome a drive, in their order."""
    outcomes: dict[int, Outcome] = {}
    progress("drives", 0, len(drives))
    for number, result in spread(partial(run_drive, output=output.absolute(), limits=limits), drives):
        drive = drives[number]
        if isinstance(result, Outcome):
            outcomes[number] = result
        else:
            reason = " ".join(f"{type(result).__name__}: {result}".split())
            outcomes[number] = Outcome(drive, output / drive.name, "failed", reason)
        progress("drives", len(outcomes), len(drives))
    return [outcomes[number] for number in range(len(drives))]


def run_drive(drive: Drive, output: Path, limits: Limits) -> Outcome:
    """Run one drive to ``output/<name>``, unless the same command left a whole run there."""
    folder = output / drive.name
    arguments = ["run", *drive.arguments, "--output", str(folder)]
    if _is_whole(folder, arguments):
        return Outcome(drive, folder, "kept")
    output.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-Pm", "slam.commands.batch.process", str(output / f".{drive.name}.lock"), *arguments]
    log = output / f"{drive.name}.log"
    with log.open("w", encoding="utf-8") as file:
        file.write(shlex.join(["erfsfm-slam", *arguments]) + "\n")
        file.flush()
        process = subprocess.Popen(
            command,
            cwd=drive.folder,
            env=os.environ | _thread_limits(limits.threads),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=file,
        )
        try:
            exceeded = _watch(process, limits.memory_gib)
        finally:
            process.kill()
            process.wait()
    if exceeded:
        return Outcome(drive, folder, "failed", exceeded)
    said = log.read_text(encoding="utf-8", errors="replace").partition("\n")[2][-_MOST_STDERR:]
    reason = why_ended(process.returncode, said)
    if not reason and not _is_whole(folder, arguments):
        reason = "it ended well and left no whole run: leave out options that only ask something"
    return Outcome(drive, folder, "failed" if reason else "whole", reason)


def _watch(process: subprocess.Popen[bytes], memory_gib: float) -> str:
    """Wait for a process; a reason where it used too much memory and was ended."""
    while True:
        try:
            process.wait(_POLL_S)
            return ""
        except subprocess.TimeoutExpired:
            used = _resident_bytes(process.pid) / _GIB
            if memory_gib and used > memory_gib:
                return f"it used {used:.1f} GiB of memory, more than the {memory_gib:.1f} GiB of --memory"


def _resident_bytes(pid: int) -> int:
    """Resident memory of a process; 0 where it cannot be read."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _thread_limits(threads: int) -> dict[str, str]:
    if not threads:
        return {}
    return dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))


def _is_whole(folder: Path, arguments: list[str]) -> bool:
    """Whether a folder holds the whole run of this command."""
    try:
        metrics = RunFolder(folder).metrics()
    except SlamError:
        return False
    return metrics.status == "ok" and metrics.provenance.command == shlex.join(["erfsfm-slam", *arguments])


def why_ended(code: int, stderr: str) -> str:
    """Why a process of ``erfsfm-slam`` failed, in one line; empty where it did not."""
    if code == 0:
        return ""
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    lines = [line.removeprefix("erfsfm-slam: ").strip() for line in stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"exit code {code}"
