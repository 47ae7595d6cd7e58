"""Files that lack their end are refused in each format, and those of text say what is missing."""

import struct

import pytest
import trimesh

from datasets.meshes import check_whole, load_mesh

BALL = trimesh.creation.icosphere(2)  # 162 vertices, 320 faces
FORMATS = {
    "obj": BALL.export(file_type="obj").encode(),
    "ply": BALL.export(file_type="ply"),
    "ascii.ply": BALL.export(file_type="ply", encoding="ascii"),
    "stl": BALL.export(file_type="stl"),
    "ascii.stl": BALL.export(file_type="stl_ascii").encode(),
    "off": BALL.export(file_type="off").encode(),
    "glb": BALL.export(file_type="glb"),
}
ROWS = r"truncated: its header claims 162 vertices and 320 faces, and it holds \d+ of these 482 rows; export or copy"
READING = "reading failed .*; export or copy it again"
MISSING = {  # what is said of a file that was cut
    "ply": READING, "glb": READING, "ascii.ply": ROWS, "off": f"({ROWS}|{READING})",
    "stl": "the file is truncated", "ascii.stl": "the file is truncated",
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_a_whole_file_is_whole(name, tmp_path):
    path = tmp_path / f"ball.{name}"
    for ending in (b"", b"\n\n") if name in ("obj", "ascii.ply", "ascii.stl", "off") else (b"",):
        path.write_bytes(FORMATS[name].rstrip(b"\n") + ending if ending else FORMATS[name])
        assert check_whole(path) == ()
        assert load_mesh(path).repairs == ()


@pytest.mark.parametrize("name", MISSING)
def test_a_file_without_its_end_is_truncated_wherever_it_was_cut(name, tmp_path):
    path = tmp_path / f"cut.{name}"
    for share in (0.02, 0.3, 0.5, 0.8, 0.99):
        path.write_bytes(FORMATS[name][: int(share * len(FORMATS[name]))])
        with pytest.raises(ValueError, match=rf"cut\.{name}': must .*{'.' if share == 0.02 else MISSING[name]}"):
            load_mesh(path)


@pytest.mark.parametrize(
    ("name", "cut"), [("stl", 50), ("ply", 13), ("ply", 1), ("glb", 4), ("ascii.ply", 5), ("off", 5)]
)
def test_a_file_without_its_last_face_or_corner_is_truncated(name, cut, tmp_path):
    (tmp_path / f"cut.{name}").write_bytes(
        FORMATS[name].rstrip(b"\n")[:-cut] if name == "off" else FORMATS[name][:-cut]
    )
    with pytest.raises(ValueError, match=MISSING[name]):
        load_mesh(tmp_path / f"cut.{name}")


def test_a_header_of_four_thousand_million_faces_is_not_believed(tmp_path):
    data = bytearray(FORMATS["stl"])
    data[80:84] = struct.pack("<I", 4_000_000_000)
    (tmp_path / "huge.stl").write_bytes(data)
    with pytest.raises(ValueError, match="must have faces, found none: the file is truncated"):
        load_mesh(tmp_path / "huge.stl")


def test_a_scan_of_text_without_its_last_number_is_truncated(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element face 0\nproperty list uchar int i\nend_header\n"
    (tmp_path / "scan.ply").write_text(f"{header}0 0 0\n1 2 3\n")
    assert check_whole(tmp_path / "scan.ply") == ()
    (tmp_path / "scan.ply").write_text(f"{header}0 0 0\n1 2\n")
    with pytest.raises(ValueError, match="its header claims 2 vertices and 0 faces, and it holds 1 of these 2 rows"):
        check_whole(tmp_path / "scan.ply")


VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
SPARE = "v 5 5 5\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (FACES.replace("2 4", "2 7") + VERTICES, "the face in line 2 names vertex 7, and there are 4"),
        (VERTICES + "f -4 -2 -3\nf 1 2 -6\n", "the face in line 6 names vertex -1, and there are 4"),
        (VERTICES + FACES[:-4], "it ends within line 8, 'f 1 '"),
        (VERTICES + FACES + "v 1.5 0.2", "it ends within line 9, 'v 1.5 0.2'"),
        (VERTICES + SPARE + FACES[:-1], "it ends within line 9, and 1 of 5 vertices are in no face"),
    ],
)
def test_an_obj_is_truncated_where_its_faces_or_its_last_line_lack_something(text, message, tmp_path):
    (tmp_path / "cut.obj").write_text(text)
    with pytest.raises(ValueError, match=f"must be a whole .obj file, but it is truncated: {message}; export or copy"):
        load_mesh(tmp_path / "cut.obj")


def test_an_obj_that_is_whole_is_not_doubted(tmp_path):
    for text in (
        VERTICES + FACES,
        VERTICES + FACES.rstrip(),
        FACES + VERTICES,  # names before what they name
        VERTICES + "f -4 -2 -3\nf -4/1 -3/1 -1/1\nf -3//1 -2//1 -1//1\nf 1 4 3 # the last\n",
        VERTICES.replace("v 0 0 1", "v 0 0 \\\n1") + FACES,
        VERTICES + SPARE + FACES + "p 5",
    ):
        (tmp_path / "whole.obj").write_text(text)
        assert check_whole(tmp_path / "whole.obj") == ()


def test_an_obj_cut_between_two_lines_is_doubted_and_the_mesh_says_so(tmp_path):
    lines = FORMATS["obj"].decode().splitlines()
    faces = [number for number, line in enumerate(lines) if line.startswith("f ")]
    (tmp_path / "half.obj").write_text("\n".join(lines[: faces[100]]) + "\n")
    repairs = load_mesh(tmp_path / "half.obj").repairs
    assert any(
        told.startswith("warning: ") and "of 162 vertices are in no face: the file may be" in told for told in repairs
    )


def test_the_counts_of_an_off_may_stand_beside_its_name(tmp_path):
    whole = FORMATS["off"].replace(b"OFF\n", b"# a ball\nOFF ", 1)
    (tmp_path / "ball.off").write_bytes(whole)
    assert load_mesh(tmp_path / "ball.off").repairs == ()
    (tmp_path / "ball.off").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="truncated: its header claims 162 vertices and 320 faces"):
        load_mesh(tmp_path / "ball.off")


def test_rows_that_are_no_numbers_are_left_to_the_reader(tmp_path):
    for name, text in {
        "words.off": "OFF\n1 1 0\n0 0 0\nx y z\n",
        "odd.ply": "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nend_header\nx y\n",
        "odd_header.ply": "ply\nformat ascii 1.0\nelement face many\nend_header\n",
        "words.obj": "v 0 0 0\nf a b c\n",
        "odd.obj": "v 0 0 0\nf 1 /2 1\nf 1 1 99999999999999999999\n",
        "odd.off": "OFF BINARY\n1 1 0\n",
    }.items():
        (tmp_path / name).write_text(text)
        assert check_whole(tmp_path / name) == ()
        with pytest.raises(ValueError, match="mesh file"):
            load_mesh(tmp_path / name)
