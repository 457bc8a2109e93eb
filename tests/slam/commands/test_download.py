"""``erfsfm-slam download`` from a server on this machine: with ranges, without, cut off, damaged."""

from __future__ import annotations

import io
import re
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from slam.commands.cli import main

pytest.importorskip("remotezip")

FRAMES = 4
Call = Callable[..., tuple[int, str, str]]


class Server(ThreadingHTTPServer):
    """Files in memory; what is wrong with it is set by its attributes."""

    daemon_threads = True

    def handle_error(self, *_: object) -> None:
        """Nothing: clients hang up here on purpose, and what is printed would be taken for theirs."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.gives_ranges = True
        self.cuts_left = 0  # answers with a body that are cut in the middle
        self.cut_from = 0  # answers before those
        self.asked: list[tuple[str, int]] = []  # path and bytes sent
        self.lock = threading.Lock()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Server

    def do_GET(self) -> None:
        server = self.server
        data = server.files.get(self.path.lstrip("/"))
        if data is None:
            self.send_error(404)
            return
        asked = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers.get("Range", ""))
        first, last = 0, len(data) - 1
        if asked and server.gives_ranges:
            if asked[1]:
                first, last = int(asked[1]), min(int(asked[2] or last), last)
            else:
                first = max(0, len(data) - int(asked[2]))
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
        else:
            self.send_response(200)
        body = data[first : last + 1]
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        with server.lock:
            is_cut = (
                server.cuts_left > 0 and len(server.asked) >= server.cut_from and len(body) > 500
            )
            server.cuts_left -= is_cut
            server.asked.append((self.path, len(body)))
        with suppress(BrokenPipeError, ConnectionResetError):
            self.wfile.write(body[: len(body) // 2] if is_cut else body)
        self.close_connection = is_cut

    def log_message(self, *_: object) -> None:
        pass


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def picture(sequence: int, k: int) -> bytes:
    return np.random.default_rng(100 * sequence + k).bytes(3000)


@pytest.fixture
def server() -> Iterator[Server]:
    """KITTI's archives with sequences 08, 09 and 11."""
    home, names = "dataset/sequences", ("08", "09", "11")
    images = {
        f"{home}/{s}/image_2/{k:06d}.png": picture(int(s), k) for s in names for k in range(FRAMES)
    }
    bulk = {
        f"{home}/20/image_2/{k:06d}.png": np.random.default_rng(k).bytes(200_000) for k in range(3)
    }
    files = {
        "data_odometry_color.zip": zipped({f"{home}/09/image_2/": b"", **images, **bulk}),
        "data_odometry_gray.zip": zipped({f"{home}/09/image_0/000000.png": b"grey"}),
        "data_odometry_calib.zip": zipped(
            {
                f"{home}/{s}/{file}": f"{s} {file}\n".encode() * 9
                for s in names
                for file in ("calib.txt", "times.txt")
            }
        ),
        "data_odometry_poses.zip": zipped(
            {f"dataset/poses/{s}.txt": b"1 0 0\n" for s in names[:2]}
        ),
        "data_odometry_velodyne.zip": zipped({f"{home}/09/velodyne/000000.bin": b"1234" * 4}),
    }
    with Server() as running:
        running.files = files
        threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
        yield running
        running.shutdown()


@pytest.fixture
def download(command_line: Call, tmp_path: Path, server: Server) -> Call:
    """Exit code, stdout and stderr, which is one line at most."""

    def call(*arguments: str) -> tuple[int, str, str]:
        words = [
            "erfsfm-slam",
            "download",
            "--to",
            tmp_path / "to",
            "--mirror",
            server.address,
            *arguments,
        ]
        code, out, err = command_line(main, *words)
        assert len(err.splitlines()) <= 1, err
        return code, out, err

    return call


KITTI = ("kitti-odometry", "--sequence", "09", "--accept-licence")


def found(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


WHOLE = {
    *(f"dataset/sequences/09/image_2/{k:06d}.png" for k in range(FRAMES)),
    *("dataset/sequences/09/calib.txt", "dataset/sequences/09/times.txt", "dataset/poses/09.txt"),
}


def test_only_the_sequence_is_fetched(tmp_path: Path, server: Server, download: Call):
    code, out, err = download(*KITTI)
    assert code == 0, err
    assert "NonCommercial" in out and "7 files in" in out and "--sequence 09" in out
    assert found(tmp_path / "to") == WHOLE
    assert (tmp_path / "to/dataset/sequences/09/image_2/000002.png").read_bytes() == picture(9, 2)
    sent = sum(count for _, count in server.asked)
    assert sent < len(server.files["data_odometry_color.zip"]) / 3


def test_what_is_there_is_not_fetched_again_and_what_is_damaged_is(
    tmp_path: Path, server: Server, download: Call
):
    download(*KITTI)
    damaged = tmp_path / "to/dataset/sequences/09/image_2/000001.png"
    damaged.write_bytes(b"x" * len(damaged.read_bytes()))
    before = damaged.with_name("000000.png").stat().st_mtime_ns
    server.asked.clear()
    assert download(*KITTI)[0] == 0
    assert damaged.read_bytes() == picture(9, 1)
    assert damaged.with_name("000000.png").stat().st_mtime_ns == before
    tables = len({path for path, _ in server.asked})
    assert len(server.asked) == tables + 1  # a table of contents each, and one image


def test_grey_images_scans_and_sequences_without_poses(tmp_path: Path, download: Call):
    assert download(*KITTI, "--camera", "grey", "--lidar")[0] == 0
    assert {
        "dataset/sequences/09/image_0/000000.png",
        "dataset/sequences/09/velodyne/000000.bin",
    } <= found(tmp_path / "to")
    assert download("kitti-odometry", "-s", "11", "--accept-licence")[0] == 0
    assert "dataset/poses/11.txt" not in found(tmp_path / "to")


@pytest.mark.parametrize("cut_from", [0, 4])
def test_one_that_keeps_breaking_is_named_and_goes_on_later(
    tmp_path: Path, server: Server, download: Call, cut_from: int
):
    server.cuts_left, server.cut_from = 10**6, cut_from
    code, _, err = download(*KITTI)
    assert code == 1 and re.search(
        r"(broke off|cannot be read) .*; run the same command again to go on", err
    )
    server.cuts_left = 0
    assert download(*KITTI)[0] == 0
    assert found(tmp_path / "to") == WHOLE


@pytest.mark.parametrize(
    "mirror, message",
    [
        ("http://127.0.0.1:9", r"\(Connection refused\); run the same command again to go on"),
        ("archives", "is no address: give --mirror as https://HOST/FOLDER"),
    ],
)
def test_no_server_at_all(download: Call, mirror: str, message: str):
    code, _, err = download(*KITTI, "--mirror", mirror)
    assert code == 1 and re.search(message, err) and len(err.splitlines()) == 1, err


def test_bytes_that_do_not_fit_their_crc_are_not_kept(
    tmp_path: Path, server: Server, download: Call
):
    data = server.files["data_odometry_color.zip"]
    start = data.index(b"dataset/sequences/09/image_2/000000.png") + 60
    server.files["data_odometry_color.zip"] = data[:start] + bytes(200) + data[start + 200 :]
    code, _, err = download(*KITTI)
    assert code == 1 and "000000.png broke off (BadZipFile: Bad CRC-32" in err
    assert "dataset/sequences/09/image_2/000000.png" not in found(tmp_path / "to")


def test_members_that_lead_out_of_the_folder_are_refused(
    tmp_path: Path, server: Server, download: Call
):
    server.files["data_odometry_color.zip"] = zipped(
        {"dataset/sequences/09/image_2/../../../../../out.png": b"x"}
    )
    code, _, err = download(*KITTI)
    assert code == 1 and "outside of its folder" in err
    assert not (tmp_path / "out.png").exists() and not found(tmp_path / "to")


def test_a_server_without_ranges_is_named_and_nothing_is_kept(
    tmp_path: Path, server: Server, download: Call
):
    server.gives_ranges = False
    code, _, err = download(*KITTI)
    assert code == 1 and "gives no parts of files" in err and not found(tmp_path / "to")
    server.gives_ranges = True
    assert download(*KITTI)[0] == 0
