"""The image's default command with the image's environment, as a plain process: no Docker, the image's user where this
one is root. Paths are mapped to folders of the test; what the image's user may not write, it may not write here."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from services.cli.client import Client
from tests.services.kernels import give_kernels
from tests.services.scans import photo_scan
from tests.services.service_process import ROOT, free_port, until

DOCKERFILE = (ROOT / "deploy" / "Dockerfile").read_text()
USER = int(re.search(r"^USER (\d+)$", DOCKERFILE, re.M)[1])
COMMAND = json.loads(re.search(r"^CMD (\[.*\])$", DOCKERFILE, re.M)[1])
LEFT_TO_COMPILE = ("pipeline/splats",)  # by the image's user, into the folder that its environment names
PASSWD_HOME = "/home" + "/" + re.search(r"useradd .* (\w+) ", DOCKERFILE)[1]  # what Docker gives where ENV has none


def image_environment() -> dict[str, str]:
    lines = re.findall(r"^ENV (.+)$", DOCKERFILE, re.M)
    return {"HOME": PASSWD_HOME, **dict(pair.split("=", 1) for line in lines for pair in shlex.split(line))}


class Image:
    """Folders that stand for those of the image, and its user."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.user, self.prefix = _as_nobody_special()
        for name in ("data", "tmp", "app", "home", "scratch"):
            (root / name).mkdir()
        for room in ("storage", "pipeline", "renderer", "services"):
            shutil.copytree(ROOT / room, root / "app" / room, ignore=shutil.ignore_patterns("__pycache__"))
        give_kernels(root / "scratch" / "numba", root / "app", but=LEFT_TO_COMPILE)
        for folder in (root / "home", *(p for p in (root / "app").rglob("*") if p.is_dir())):
            folder.chmod(0o555)
        if self.user:
            owned = (root / "data", root / "scratch", *(root / "scratch").rglob("*"))
            [os.chown(path, USER, USER) for path in owned], (root / "tmp").chmod(0o1777)
        self.port = free_port()

    def here(self, text: str) -> str:
        text = text.replace("/venv/bin", str(Path(sys.executable).parent)).replace("$PATH", os.environ["PATH"])
        return re.sub(r"(?<![\w/])/(data|tmp|home|scratch)(?=/|$)", lambda m: str(self.root / m[1]), text)

    @property
    def environment(self) -> dict[str, str]:
        given = {name: self.here(value) for name, value in image_environment().items()}
        return {
            **given,
            "PYTHONPATH": str(self.root / "app"),
            "SPLATPRESS_PORT": str(self.port),
            "SPLATPRESS_WORKERS": "1",
        }

    def start(self, stream) -> subprocess.Popen:
        return subprocess.Popen(
            [*self.prefix, *(self.here(part) for part in COMMAND)],
            env=self.environment,
            cwd="/",
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            **self.user,
        )

    def run(self, *command: str) -> str:
        return subprocess.run(
            [*self.prefix, *command],
            env=self.environment,
            cwd="/",
            check=True,
            capture_output=True,
            text=True,
            **self.user,
        ).stdout.strip()


def _as_nobody_special() -> tuple[dict, list[str]]:
    """How to run without root's right to write anywhere: as the image's user; where that one may not run this Python,
    as root without the capability; as ourselves where we are not root."""
    as_user = {"user": USER, "group": USER, "extra_groups": []}
    if os.getuid() != 0:
        return {}, []
    with suppress(PermissionError):
        if (
            subprocess.run([sys.executable, "-c", "import numba"], **as_user, capture_output=True, cwd="/").returncode
            == 0
        ):
            return as_user, []
    drop = ["setpriv", "--bounding-set=-dac_override", "--inh-caps=-dac_override"]
    if shutil.which("setpriv") is None or subprocess.run([*drop, "true"]).returncode != 0:
        pytest.skip(f"root here, and user {USER} may not run {sys.executable}, nor is there setpriv")
    return {}, drop


@contextmanager
def started_image():
    """Its service, ready: a client with the token of an owner."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        Path(folder).chmod(0o755)
        image = Image(Path(folder))
        with open(Path(folder) / "log", "w") as stream:
            process = image.start(stream)
        url, log = f"http://127.0.0.1:{image.port}", Path(folder) / "log"

        def is_ready() -> bool:
            assert process.poll() is None and "starting it anew" not in log.read_text(), log.read_text()[-3000:]
            try:
                return httpx.get(url + "/readyz").status_code == 200
            except httpx.TransportError:
                return False

        try:
            until(is_ready)
            yield lambda owner: Client(url, image.run("splatpress", "token", owner, "--data", image.here("/data")))
            assert [*(image.root / "scratch" / "numba").rglob("splats_*/*.nbc")]
        finally:
            process.terminate()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)


def test_image__its_environment_names_folders_that_its_user_may_write():
    environment = image_environment()
    assert (
        USER == 10001
        and environment["HOME"] == "/scratch"
        and Path(environment["NUMBA_CACHE_DIR"]).parent == Path("/scratch")
    )
    assert re.search(r"install -d -m 700 -o splatpress (\S+ )*/scratch", DOCKERFILE)


@pytest.mark.skipif(
    shutil.which("splatpress", path=str(Path(sys.executable).parent)) is None, reason="splatpress is not installed here"
)
def test_image__its_default_command_starts_and_a_job_goes_through(tmp_path):
    options = {"iterations": 1, "training_splats": 500}
    scan = photo_scan(tmp_path / "plane", n_side=24)
    with started_image() as client_of, client_of("ann") as client:
        job = client.submit(client.upload(scan)["id"], preset="draft", options=options)["jobID"]
        ended = client.watch(job, lambda event: None)
        assert ended["status"] == "successful", ended["problem"]
        assert {"plane.splatpress", "report.html"} <= {a["name"] for a in client.artifacts(job)}
        # The same bytes brought by another owner under another name: nothing of his job tells of the first
        scan.rename(tmp_path / "bridge")
        with client_of("bob") as other:
            found = other.upload(tmp_path / "bridge")
            assert found["file"] == "bridge.zip" and found["id"] == ended["scan"]
            job = other.submit(found["id"], preset="draft", options=options)["jobID"]
            assert other.watch(job, lambda event: None)["name"] == "bridge"
            assert "bridge.splatpress" in {a["name"] for a in other.artifacts(job)}
            paths = other.fetch(job, tmp_path / "out")
            texts = [path.read_text() for path in paths if path.suffix in (".json", ".html")]
            assert texts and not [text for text in texts if re.search(r"\bplane(\.zip|\.splatpress|\")", text)]


IMAGE = os.environ.get("SPLATPRESS_TEST_IMAGE", "")


@pytest.mark.skipif(not IMAGE or shutil.which("buildah") is None, reason="SPLATPRESS_TEST_IMAGE names no image")
def test_image__one_that_was_built_starts_by_its_default_command_and_a_job_goes_through(tmp_path):
    """`SPLATPRESS_TEST_IMAGE=splatpress`, after `deploy/build-image.sh`; as root, for want of a container runtime in a
    folder of its own with this machine's network."""
    container = _buildah("from", IMAGE)
    port = free_port()
    try:
        command = json.loads(_buildah("inspect", container))["OCIv1"]["config"]["Cmd"]
        assert command == COMMAND
        run = [
            "buildah",
            "run",
            "--isolation",
            "chroot",
            "--env",
            f"SPLATPRESS_PORT={port}",
            "--env",
            "SPLATPRESS_WORKERS=1",
        ]
        process = subprocess.Popen([*run, container, "--", *command], start_new_session=True)
        try:
            until(lambda: process.poll() is not None or _is_ready(port), 300)
            token = subprocess.check_output(
                [*run, container, "--", "splatpress", "token", "ann", "--data", "/data"], text=True
            )
            with Client(f"http://127.0.0.1:{port}", token.strip()) as client:
                scan = client.upload(photo_scan(tmp_path / "plane", n_side=24))["id"]
                job = client.submit(scan, preset="draft", options={"iterations": 1, "training_splats": 500})["jobID"]
                ended = client.watch(job, lambda event: None)
                assert ended["status"] == "successful", ended["problem"]
                assert {"plane.splatpress", "report.html", "previews/0000.packed.png"} <= {
                    a["name"] for a in client.artifacts(job)
                }
        finally:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(30)
    finally:
        _buildah("rm", container)


def _is_ready(port: int) -> bool:
    try:
        return httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200
    except httpx.TransportError:
        return False


def _buildah(*arguments: str) -> str:
    return subprocess.check_output(["buildah", *arguments], text=True).strip()
