"""SLURM on this machine alone, with daemons, key, sockets and states in one folder (Debian: slurm-wlm and munge).

It needs root, because slurmd starts jobs for users. Nothing of an installation that runs already is touched: the
daemons listen on 127.0.0.1 and on ports of their own.
"""

import os
import platform
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scontrol")
WITHIN_S = 60.0  # that the node has to become idle
CONFIGURATION = """ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={control_port}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
ReturnToService=2
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=2,batch_sched_delay=1
KillWait=10
MinJobAge=10
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
NODE = "NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs=1 RealMemory={memory} State=UNKNOWN\n"


def missing() -> list[str]:
    """Programs of SLURM that this machine lacks."""
    return [name for name in PROGRAMS if shutil.which(name, path=_search_path()) is None]


@contextmanager
def loopback_slurm(folder: Path, count: int = 2, memory_mb: int = 4000) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    """Run SLURM with nodes of one processor, all on this machine; yields the daemon of each node by its name.

    The commands of SLURM find it by SLURM_CONF in `os.environ`.

    Args:
        folder: a new one, for all files.
        count: number of nodes.
        memory_mb: of each node, whether or not the machine has it.

    Raises:
        RuntimeError: the nodes do not become idle.
    """
    host = platform.node().partition(".")[0]
    names = [f"node{number + 1}" for number in range(count)]
    for name in ("state", "munge", *(f"spool-{node}" for node in names)):
        (folder / name).mkdir(parents=True)
    folder.chmod(0o755)
    (folder / "munge").chmod(0o700)
    key = folder / "munge" / "key"
    key.write_bytes(os.urandom(128))
    key.chmod(0o400)
    configuration = folder / "slurm.conf"
    head = CONFIGURATION.format(host=host, folder=folder, control_port=_free_port())
    nodes = (NODE.format(name=name, host=host, port=_free_port(), memory=memory_mb) for name in names)
    configuration.write_text(head + "".join(nodes))
    before = os.environ.get("SLURM_CONF")
    os.environ["SLURM_CONF"] = str(configuration)
    munged = ["munged", "--foreground", "--force", f"--socket={folder}/munge.socket", f"--key-file={key}"]
    munged += [f"--{name}-file={folder}/munge/{name}" for name in ("log", "pid", "seed")]
    daemons: dict[str, subprocess.Popen[bytes]] = {}
    try:
        daemons["munged"] = _started(munged, folder)
        time.sleep(1.0)
        daemons["slurmctld"] = _started(["slurmctld", "-D", "-i"], folder)
        time.sleep(1.0)
        workers = {name: _started(["slurmd", "-D", "-N", name], folder) for name in names}
        daemons |= workers
        _wait_for_nodes(count, folder)
        yield workers
    finally:
        for daemon in reversed(daemons.values()):
            daemon.terminate()
            daemon.wait(30)
        if before is None:
            del os.environ["SLURM_CONF"]
        else:
            os.environ["SLURM_CONF"] = before


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _started(line: list[str], folder: Path) -> subprocess.Popen[bytes]:
    program = shutil.which(line[0], path=_search_path())
    assert program is not None
    with (folder / f"{line[0]}.out").open("a") as out:
        return subprocess.Popen([program, *line[1:]], stdout=out, stderr=out)


def _search_path() -> str:
    return os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/bin"])


def _wait_for_nodes(count: int, folder: Path) -> None:
    end = time.monotonic() + WITHIN_S
    while time.monotonic() < end:
        found = subprocess.run(["sinfo", "--noheader", "--Node", "--format", "%T"], capture_output=True, text=True)
        if found.stdout.split() == ["idle"] * count:
            return
        time.sleep(0.5)
    raise RuntimeError(f"{count} nodes did not become idle within {WITHIN_S:g} s; see the logs in {folder}")
