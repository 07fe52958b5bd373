"""The session folder: what is accepted, what is refused and and images that are not what they should be."""

from __future__ import annotations

import copy
import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from conftest import shared
from synthetic import hand_eye
from weldscan import InputError
from weldscan.records.frames import iter_frames, read_frames
from weldscan.records.hand_eye import read_hand_eye, write_hand_eye
from weldscan.records.images import read_image
from weldscan.records.session import Session, frame_names, read_session, write_session

POSE = {"X": 1.0, "Y": 2.0, "Z": 3.0, "A": 10.0, "B": 20.0, "C": 30.0}
LENS = {"width": 8, "height": 6, "K": [[10, 0, 4], [0, 10, 3], [0, 0, 1]], "dist": [0, 0, 0, 0]}
PIPE = {
    "kind": "pipe",
    "outside_diameter": 630.0,
    "wall_thickness": 6.0,
    "joint": "circumferential butt",
    "axis_base": [1, 0, 0],
    "zero_base": [0, 1, 0],
}
SESSION = {
    "schema": "weldscan-session/1",
    "name": "small",
    "scanner": {
        "camera": LENS,
        "projector": LENS,
        "camera_from_projector": [[1, 0, 0, -150], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    },
    "fringes": [{"axis": "x", "periods": 1, "steps": 3}, {"axis": "x", "periods": 4, "steps": 4}],
    "artefact": {
        "kind": "three-sphere plate",
        "sphere_diameter": 20.0,
        "centres_base": [[0, 0, 0], [50, 0, 0], [0, 60, 0]],
    },
    "part": PIPE,
    "robot": {"model": "KUKA KR10 R1100"},
    "shots": [
        {"name": "artefact-1", "of": "artefact", "flange_pose": POSE},
        {"name": "part-1", "of": "part", "flange_pose": POSE, "exposures": [0.5, 2.0]},
    ],
}
HAND_EYE = {
    "schema": "weldscan-hand-eye/1",
    "id": "cell-7",
    "date": "2020-01-01T00:00:00Z",
    "flange_from_scanner": np.eye(4).tolist(),
    "covariance": (np.eye(6) * 1e-4).tolist(),
    "residual_rms_mm": 0.03,
}
GONE = object()


def changed(path: str, value: object, document: dict = SESSION) -> dict:
    """The session with one field replaced (or taken away)."""
    document = json.loads(json.dumps(document))  # nothing shared any more
    *parents, last = [int(step) if step.isdigit() else step for step in path.split(".")]
    holder = document
    for step in parents:
        holder = holder[step]
    if value is GONE:
        del holder[last]
    else:
        holder[last] = value
    return document


def frames_for(session: Session, dtype: type = np.uint8) -> dict[str, list[list[np.ndarray]]]:
    random = np.random.default_rng(1)
    camera = session.scanner.camera
    return {
        shot.name: [
            [random.integers(0, np.iinfo(dtype).max, (camera.height, camera.width)).astype(dtype) for _ in row]
            for row in frame_names(session, shot)
        ]
        for shot in session.shots
    }


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small, valid session with images."""
    session = Session.model_validate_json(json.dumps(SESSION))
    write_session(tmp_path / "small", session, frames_for(session).items())
    return tmp_path / "small"


def complaint(folder: Path, text: str | bytes) -> str:
    (folder / "session.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as error:
        read_session(folder)
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith(str(folder / "session.json") + ": ")
    return message.removeprefix(str(folder / "session.json") + ": ")


@pytest.mark.parametrize("name", ["open-630", "open-273"])
def test_the_examples_are_read(name):
    session = read_session(shared(f"sessions/{name}"))
    assert session.name == name
    assert [shot.of for shot in session.shots] == ["artefact"] * 6 + ["part"] * 2
    assert session.has_robot and len(session.artefact_shots) == 6
    frames = read_frames(session, session.shots[-1])
    assert [len(row) for row in frames] == [12] * len(session.shots[-1].exposures or (1,))
    image = session.folder / "shots" / "part-2" / frame_names(session, session.shots[-1])[-1][5]
    assert np.array_equal(frames[-1][5], cv2.imread(str(image), cv2.IMREAD_UNCHANGED))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_what_is_written_is_read_back(tmp_path, dtype):
    session = Session.model_validate_json(json.dumps(SESSION))
    frames = frames_for(session, dtype)
    whites = {"part-1": [row[0] for row in frames["part-1"]]}
    again = write_session(tmp_path / "out", session, frames.items(), whites=whites, extra={"touch.csv": "x_mm\n"})
    assert again.model_dump() == session.model_dump()
    assert again.folder == tmp_path / "out"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out" / "touch.csv").read_text() == "x_mm\n"
    assert np.array_equal(read_image(tmp_path / "out" / "shots" / "part-1" / "e1_white.png"), whites["part-1"][1])
    for shot, read in iter_frames(again, again.shots):
        assert [[a.dtype for a in row] for row in read] == [[dtype] * 7] * len(frames[shot.name])
        assert np.array_equal(np.array(read), np.array(frames[shot.name]))


def test_a_session_that_fails_half_way_leaves_nothing(tmp_path):
    session = Session.model_validate_json(json.dumps(SESSION))
    frames = frames_for(session)
    with pytest.raises(InputError, match="none for shot 'part-1'"):
        write_session(tmp_path / "out", session, [("artefact-1", frames["artefact-1"])])
    frames["part-1"][1][2] = frames["part-1"][1][2][:-1]
    with pytest.raises(InputError, match=r"part-1/e1_002\.png"):
        write_session(tmp_path / "out", session, frames.items())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(InputError, match="holds something else"):
        write_session(tmp_path / "out", session, frames_for(session).items())


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("schema", "weldscan-session/2", "schema: should be 'weldscan-session/1', not \"weldscan-session/2\""),
        ("schema", GONE, "schema: missing"),
        ("part.required_coverage_deg", 0, "part.required_coverage_deg: should be greater than 0"),
        ("part.required_coverage_deg", 361, "part.required_coverage_deg: should be less than or equal to 360"),
        ("name", GONE, "name: missing"),
        ("colour", "red", "colour: unknown field"),
        ("shots.1.flange_pose.B", float("nan"), "shots.1.flange_pose.B: NaN is not a number"),
        ("shots.1.flange_pose.B", float("-inf"), "shots.1.flange_pose.B: infinity is not a number"),
        ("shots.1.flange_pose.B", "20", 'shots.1.flange_pose.B: should be a valid number, not "20"'),
        ("shots.1.flange_pose.B", GONE, "shots.1.flange_pose.B: missing"),
        ("shots.1.flange_pose", GONE, "shots.1.flange_pose: missing, though shots.0 has one"),
        ("shots.1.name", "artefact-1", "shots.1.name: 'artefact-1' is also the name of shots.0"),
        ("shots.1.name", "../part-1", "shots.1.name: '../part-1' cannot name a folder"),
        ("shots.1.name", "..", "shots.1.name: '..' cannot name a folder"),
        ("shots.1.name", "a\\b", "shots.1.name: 'a\\\\b' cannot name a folder"),
        ("shots.1.name", "", "shots.1.name: '' cannot name a folder"),
        ("shots.1.of", "wall", "shots.1.of: should be 'artefact', 'part' or 'plane', not \"wall\""),
        ("shots.1.exposures", [1, 1], "shots.1: exposures: one of them is there twice"),
        ("shots.1.exposures", [1, 0], "shots.1.exposures.1: should be greater than 0, not 0"),
        ("shots", [], "shots: "),
        ("shots", 7, "shots: should be a list, not 7"),
        ("fringes", [], "fringes: "),
        ("fringes.1.periods", 1, "fringes.1.periods: 1 is there twice on axis x"),
        ("fringes.1.periods", 5, "fringes.1.periods: 8 projector pixels cannot show 5 fringes"),
        ("fringes.1.steps", 2, "fringes.1.steps: should be greater than or equal to 3, not 2"),
        ("fringes.1.axis", "z", "fringes.1.axis: should be 'x' or 'y'"),
        ("scanner.projector.width", 0, "scanner.projector.width: should be greater than or equal to 1, not 0"),
        ("scanner.camera.dist", [0, 0, 0], "scanner.camera.dist: "),
        ("scanner.camera.K.0.0", -1, "scanner.camera.K: the focal lengths"),
        ("scanner.camera.K.0.1", 0.5, "scanner.camera.K: should read [[fx, 0, cx]"),
        ("scanner.camera.K", [[1, 0], [0, 1]], "scanner.camera.K: should be 3 rows of 3 numbers"),
        ("scanner.camera_from_projector.0.0", -1, "scanner.camera_from_projector: the rotation is mirrored"),
        ("scanner.camera_from_projector.0.0", 1.001, "scanner.camera_from_projector: the rotation is not orthonormal"),
        (
            "scanner.camera_from_projector.0.3",
            0,
            "scanner: camera_from_projector: camera and projector stand in one place",
        ),
        ("scanner.camera_from_projector.3.3", 2, "scanner.camera_from_projector: the last row"),
        ("artefact", GONE, "shots.0.of: a shot of the artefact, but the session describes no artefact"),
        ("artefact.sphere_diameter", -20, "artefact.sphere_diameter: should be greater than 0"),
        ("artefact.sphere_diameter", 51, "artefact: centres_base: spheres 1 and 2 are 50 mm apart"),
        ("artefact.centres_base.1", [0, 0, 0], "artefact: centres_base: spheres 1 and 2 are 0 mm apart"),
        ("artefact.centres_base.1", [0, 30, 0], "artefact: centres_base: the three centres lie on one line"),
        ("artefact.centres_base", [[0, 0, 0]], "artefact.centres_base.1: missing"),
        ("part", GONE, "part: missing, though there are shots of it"),
        ("part.kind", "elephant", "part.kind: should be 'pipe'"),
        ("part.kind", "plate", "part.kind: a plate cannot be measured yet, only the girth weld of a pipe"),
        ("part.wall_thickness", 315, "part: wall_thickness: 315 mm is not less than the outside radius of 315 mm"),
        ("part.wall_thickness", 0, "part.wall_thickness: should be greater than 0"),
        ("part.outside_diameter", True, "part.outside_diameter: should be a valid number, not true"),
        ("part.axis_base", [0, 0, 0], "part.axis_base: is a zero vector"),
        ("part.zero_base", [-2, 0, 0], "part: zero_base: is parallel to axis_base"),
        ("part.zero_base", GONE, "part: zero_base: missing"),
        ("hand_eye", HAND_EYE, "hand_eye: given together with artefact shots"),
    ],
)
def test_a_wrong_field_is_named(folder, path, value, says):
    assert complaint(folder, json.dumps(changed(path, value))).startswith(says)


def test_what_is_not_json_is_named(folder):
    text = json.dumps(SESSION)
    assert "is not JSON: " in complaint(folder, text[:-1])
    assert complaint(folder, text[:100]).startswith("is not JSON: ")
    assert complaint(folder, b"\xff\xfe" + text.encode("utf-16le")).startswith("is not UTF-8: byte 0 is 0xff")
    assert complaint(folder, text.replace('"small"', '"small", "name": "big"')) == "name: the field is there twice"
    assert complaint(folder, "[" * 100_000).startswith("is ")
    assert complaint(folder, "[]").startswith("should be an object")
    assert complaint(folder, "").startswith("is not JSON")
    (folder / "session.json").unlink()
    with pytest.raises(InputError, match=r"session\.json: no such file"):
        read_session(folder)
    with pytest.raises(InputError, match="no such folder"):
        read_session(folder / "nowhere")
    with pytest.raises(InputError, match="is not a folder"):
        read_session(folder / "shots" / "part-1" / "e0_000.png")


def test_a_session_without_a_robot_is_one_shot_of_the_part(folder):
    alone = copy.deepcopy(SESSION)
    del alone["robot"], alone["artefact"], alone["part"]["axis_base"], alone["part"]["zero_base"]
    alone["shots"] = [{"name": "part-1", "of": "part"}]
    (folder / "session.json").write_text(json.dumps(alone))
    assert not read_session(folder).has_robot
    # What the cell has beside does no harm.
    described = alone | {key: SESSION[key] for key in ("robot", "artefact")}
    (folder / "session.json").write_text(json.dumps(described))
    assert not read_session(folder).has_robot
    for path, value, says in (
        ("shots", [{"name": "a", "of": "part"}, {"name": "b", "of": "part"}], "shots.0.flange_pose: missing; only"),
        ("hand_eye", HAND_EYE, "hand_eye: given, but the shots have no flange_pose"),
        ("shots.0.flange_pose", POSE, "part.axis_base: missing; only"),
    ):
        assert complaint(folder, json.dumps(changed(path, value, alone))).startswith(says)


def test_fringes_come_in_any_order(folder):
    (folder / "session.json").write_text(json.dumps(changed("fringes.1.periods", 0.5)))
    assert [fringe.periods for fringe in read_session(folder).fringes] == [1, 0.5]


def test_a_session_may_carry_its_hand_eye(folder):
    carried = copy.deepcopy(SESSION)
    del carried["artefact"]
    carried["shots"] = carried["shots"][1:]
    assert complaint(folder, json.dumps(carried)).startswith("hand_eye: missing")
    for held in (HAND_EYE, "hand-eye.json"):
        (folder / "hand-eye.json").write_text(json.dumps(HAND_EYE))
        (folder / "session.json").write_text(json.dumps(carried | {"hand_eye": held}))
        session = read_session(folder)
        assert session.hand_eye.id == "cell-7"
    (folder.parent / "hand-eye.json").write_text(json.dumps(HAND_EYE))
    for outside in ("../hand-eye.json", str(folder / "hand-eye.json")):
        said = complaint(folder, json.dumps(carried | {"hand_eye": outside}))
        assert "is not a file inside the session's folder" in said
    wrong = changed("flange_from_scanner.0.0", -1, HAND_EYE)
    said = complaint(folder, json.dumps(carried | {"hand_eye": wrong}))
    assert said.startswith("hand_eye.flange_from_scanner: the rotation is mirrored")
    wrong = changed("covariance.0.0", -1, HAND_EYE)
    assert complaint(folder, json.dumps(carried | {"hand_eye": wrong})).startswith(
        "hand_eye.covariance: is not a covar"
    )
    (folder / "hand-eye.json").write_text(json.dumps(changed("id", GONE, HAND_EYE)))
    (folder / "session.json").write_text(json.dumps(carried | {"hand_eye": "hand-eye.json"}))
    with pytest.raises(InputError, match=r"hand-eye\.json: id: missing"):
        read_session(folder)


def test_a_calibration_is_kept_and_read_back(tmp_path):
    kept = write_hand_eye(tmp_path / "hand-eye.json", hand_eye())
    assert np.array_equal(kept.flange_from_scanner, hand_eye().flange_from_scanner) and len(kept.per_shot) == 6
    assert kept.covariance[0][0] == hand_eye().covariance[0, 0] and kept.id == hand_eye().id
    write_hand_eye(tmp_path / "hand-eye.json", hand_eye(2))
    assert len(read_hand_eye(tmp_path / "hand-eye.json").per_shot) == 2
    (tmp_path / "mine.json").write_text("{}")
    with pytest.raises(InputError, match="exists and is no hand-eye calibration"):
        write_hand_eye(tmp_path / "mine.json", hand_eye())
    with pytest.raises(InputError, match="cannot be written"):
        write_hand_eye(tmp_path / "nowhere" / "hand-eye.json", hand_eye())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand-eye.json", "mine.json"]


def png(width=8, height=6, depth=8, colour=0, rows=None, extra=b""):
    """A PNG by hand, as odd as wanted."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    rows = rows if rows is not None else (b"\0" + b"\x80" * ((width * depth * channels + 7) // 8)) * height
    palette = chunk(b"PLTE", b"\1\2\3" * 256) if colour == 3 else b""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + extra + palette + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


PNG = png()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (None, "no such image"),
        (b"", "is empty"),
        (b"hello", "is not a PNG image"),
        (PNG[:-5], "is truncated"),
        (PNG[: len(PNG) // 2], "is truncated"),
        (PNG[:8], "is truncated"),
        (PNG[:45] + bytes([PNG[45] ^ 1]) + PNG[46:], "is a damaged PNG: "),
        (png(rows=b"\0" * 10), "is a damaged PNG: "),
        (png(rows=b"\7" + b"\0" * 53), "is a damaged PNG: "),
        (png(width=9), "is 9x6 pixels, but the camera has 8x6"),
        (png(width=2**31 - 1, rows=b""), "is "),
        (png(colour=2), "is colour, but should be grey"),
        (png(colour=3), "is colour (a palette), but should be grey"),
        (png(colour=4), "is grey with transparency, but should be grey"),
        (png(colour=6), "is colour with transparency, but should be grey"),
        (png(depth=1), "is of 1 bits, but should be of 8 or 16"),
        (png(depth=16), "is of 16 bits, while the shot's first image is of 8"),
    ],
)
def test_a_wrong_image_is_named(folder, data, says, capfd):
    path = folder / "shots" / "part-1" / "e1_004.png"
    path.unlink() if data is None else path.write_bytes(data)
    session = read_session(folder)
    read_frames(session, session.shots[0])
    with pytest.raises(InputError) as error:
        read_frames(session, session.shots[1])
    assert str(error.value).startswith(f"{path}: {says}")
    assert capfd.readouterr().err == ""


def test_a_shot_may_have_16_bits_and_ancillary_chunks(folder, capfd):
    bad_profile = struct.pack(">I", 4) + b"iCCP" + b"x\0\0y" + struct.pack(">I", zlib.crc32(b"iCCPx\0\0y"))
    for path in (folder / "shots" / "artefact-1").iterdir():
        path.write_bytes(png(depth=16, extra=bad_profile))
    session = read_session(folder)
    image = read_frames(session, session.shots[0])[0][0]
    assert image.dtype == np.uint16 and (image == 0x8080).all()
    assert capfd.readouterr().err == ""


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_no_damage_to_an_image_does_anything_but_an_input_error(tmp_path, data):
    damaged = bytearray(PNG)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(PNG) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(PNG)))
    path = tmp_path / "image.png"
    path.write_bytes(bytes(damaged[:cut]))
    try:
        assert (read_image(path, (8, 6)) == 0x80).all()
    except InputError:
        assert bytes(damaged[:cut]) != PNG


SCALARS = st.none() | st.booleans() | st.integers(-3, 3) | st.floats() | st.text(max_size=3)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_no_json_does_anything_but_an_input_error(tmp_path, data):
    def paths(value, path=""):
        for key, child in value.items() if isinstance(value, dict) else enumerate(value):
            yield f"{path}{key}"
            if isinstance(child, dict | list):
                yield from paths(child, f"{path}{key}.")

    document = SESSION
    path = data.draw(st.sampled_from(list(paths(SESSION))))
    value = data.draw(st.just(GONE) | SCALARS | st.lists(SCALARS, max_size=4) | st.dictionaries(st.text(), SCALARS))
    document = changed(path, value)
    (tmp_path / "session.json").write_text(json.dumps(document))
    try:
        read_session(tmp_path)
    except InputError as error:
        assert "\n" not in str(error)
