"""Text, numbers and names of files as people's tools write them; no name leads out of its folder."""

from __future__ import annotations

import json
import os
import sys
import unicodedata
from contextlib import chdir, suppress
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from annotator.files import open_text_file, read_text_file
from annotator.formats.frame_names import PictureLabels
from annotator.formats.rcv import _inside as of_rcv
from annotator.formats.reading import read_text
from annotator.formats.yolo import read_yolo
from annotator.recordings.tum_rgbd import TumRgbd
from annotator.text import NotTextError, OutsideError, decoded, inside, is_within, normal, spelled, stem_of, to_number
from annotator.types.errors import AnnotatorError, FormatError

TWO_LINES = "0 ä\n1 é\n"


@pytest.mark.parametrize(
    "content",
    [
        TWO_LINES.encode(),
        TWO_LINES.encode("utf-8-sig"),
        b"\xfe\xff" + TWO_LINES.encode("utf-16-be"),
        TWO_LINES.encode("utf-32"),
        TWO_LINES.replace("\n", "\r\n").encode("utf-8-sig"),
        TWO_LINES.replace("\n", "\r").encode(),
    ],
    ids=["utf-8", "mark", "utf-16-be", "utf-32", "crlf", "cr"],
)
def test_marks_and_line_ends_of_other_systems_are_read(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    assert read_text_file(path) == TWO_LINES
    assert read_text(path).splitlines() == TWO_LINES.splitlines()
    with open_text_file(path, 100) as file:
        assert file.read() == TWO_LINES


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("a\nä".encode("latin-1"), r"not UTF-8 text in line 2 \(0xe4\); save it as UTF-8"),
        ("ä".encode("utf-16")[:-1], "not UTF-16 text in line 1"),
    ],
)
def test_other_encodings_are_refused_with_their_place(tmp_path: Path, content: bytes, says: str) -> None:
    with pytest.raises(NotTextError, match=says):
        decoded(content)
    (tmp_path / "a.txt").write_bytes(content)
    with pytest.raises(FormatError, match=rf"a\.txt: is {says}"):
        read_text(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("text", "has_comma"),
    [
        ("1.234,5", True),
        ("1,5;2,5", True),
        ("1_000", False),
        ("", False),
    ],
)
def test_what_is_no_number_is_quoted_and_a_decimal_comma_is_named(text: str, has_comma: bool) -> None:
    says = "has a decimal comma; write a point" if has_comma else "is not a number"
    with pytest.raises(ValueError, match=f"^'{text}' {says}$"):
        to_number(text)


NFC, NFD = "café", unicodedata.normalize("NFD", "café")
PARTS = ["..", ".", "", "a.txt", "deep", "in", "out", "set", "secret", "C:", "~", NFC, NFD, "b c", "x" * 300, "\0"]
NAMES = st.builds(
    lambda start, parts, by: start + by.join(parts),
    st.sampled_from(["", "", "", "/", "//", "\\", "\\\\", "C:\\", "c:/"]),
    st.lists(st.sampled_from(PARTS), min_size=1, max_size=6),
    st.sampled_from(["/", "\\"]),
)
opened: list[str] = []
sys.addaudithook(lambda event, values: opened.append(os.fsdecode(values[0])) if _is_opening(event, values) else None)


def _is_opening(event: str, values: tuple[object, ...]) -> bool:
    return event == "open" and isinstance(values[0], str | bytes) and "names-of-files" in os.fsdecode(values[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set with links into it and out of it, and files beside it."""
    root = tmp_path_factory.mktemp("names-of-files")
    for name in ("set/a.txt", f"set/deep/{NFD}", "set/deep/images/x.png", "secret/a.txt", "a.txt", "deep/images/x.png"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("x")
    (root / "set" / "in").symlink_to("deep")
    (root / "set" / "out").symlink_to("../secret")
    (root / "set" / "deep" / "out").symlink_to("../../a.txt")
    return root / "set"


@given(name=NAMES, is_relative=st.booleans())
@example(name="../deep/images", is_relative=True)
@example(name="out/a.txt", is_relative=True)
@example(name="..\\secret\\a.txt", is_relative=False)
def test_no_name_leads_out_of_its_folder(folder: Path, name: str, is_relative: bool) -> None:
    with chdir(folder.parent):
        root = Path("set") if is_relative else folder
        try:
            path = inside(root, name)
        except OutsideError as error:
            assert str(error).endswith("; write it relative to the folder")
        else:
            assert Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
            assert is_within(root, path)
        # a folder that is linked into a TUM recording is a part of it
        linked = (folder, folder.parent / "secret")
        for read, allowed in ((by_tum, linked), (by_coco, (folder,)), (by_rcv, (folder,))):
            with suppress(AnnotatorError):
                path = read(root, name)
                assert path is None or any(is_within(each, Path(os.path.realpath(path))) for each in allowed)


def by_tum(root: Path, name: str) -> Path:
    return TumRgbd(root, (), (), (), 0, 0, None)._file(name)


def by_coco(root: Path, name: str) -> Path | None:
    return PictureLabels(name, (), folder=root).file(root)


def by_rcv(root: Path, name: str) -> Path:
    return of_rcv(root, name, root)


@settings(max_examples=40)
@given(names=st.tuples(NAMES, NAMES, NAMES), is_relative=st.booleans())
@example(names=("", "../deep/images", "../valid/images"), is_relative=True)
@example(names=("..", "deep/images", "list.txt"), is_relative=True)
def test_no_list_of_a_yolo_dataset_leads_out(folder: Path, names: tuple[str, str, str], is_relative: bool) -> None:
    base, train, listed = names
    with chdir(folder.parent):
        (folder / "list.txt").write_bytes(f"{listed}\n".encode())
        (folder / "data.yaml").write_text(
            json.dumps({"path": base, "train": train, "val": "list.txt", "names": ["a"]}), encoding="utf-8"
        )
        opened.clear()
        with suppress(FormatError):
            read_yolo(Path("set") if is_relative else folder)
        outside = [path for path in opened if not Path(os.path.realpath(path)).is_relative_to(folder.resolve())]
        assert outside == []


def test_a_relative_root_is_no_way_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A root is joined once: `set/../deep` is outside, though `set/set/../deep` would be inside."""
    monkeypatch.chdir(folder.parent)
    assert not is_within(Path("set"), Path("set/../deep"))
    assert is_within(Path("set"), Path("set/deep"))
    (folder / "data.yaml").write_text("train: deep/images\nval: ../valid/images\nnames: [a]")
    with pytest.raises(FormatError, match=r"data\.yaml: val: there is no '\.\./valid/images' in the dataset's folder"):
        read_yolo(Path("set"))


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("a.txt", "a.txt"),
        (".\\deep/images\\x.png", "deep/images/x.png"),
        ("deep/../a.txt", "deep/../a.txt"),
        (f"deep\\{NFC}", f"deep/{NFD}"),
        ("missing\\b c.txt ", "missing/b c.txt "),
    ],
)
def test_names_of_other_systems_are_found(folder: Path, name: str, found: str) -> None:
    assert inside(folder, name) == folder / found


def test_an_own_name_with_a_backslash_is_found(tmp_path: Path) -> None:
    (tmp_path / "a\\b.txt").touch()
    assert inside(tmp_path, "a\\b.txt") == tmp_path / "a\\b.txt"


@pytest.mark.parametrize("name", ["C:\\data\\a.txt", "d:/a.txt", "\\\\server\\share\\a.txt"])
def test_paths_of_another_computer_are_refused_by_that_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutsideError, match="is a path of another computer; write it relative to the folder"):
        inside(tmp_path, name)
    assert stem_of(name) == "a"


def test_names_are_compared_in_one_form(tmp_path: Path) -> None:
    for form, other in (("NFC", "NFD"), ("NFD", "NFC")):
        written, given_name = (unicodedata.normalize(each, f"Größe_한글_{form}") for each in (form, other))
        (tmp_path / f"{written}.txt").touch()
        assert normal(given_name) == normal(written)
        assert spelled(tmp_path, f"{given_name}.txt") == tmp_path / f"{written}.txt"
    assert spelled(tmp_path, "é.txt") == tmp_path / "é.txt"
