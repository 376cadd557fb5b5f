"""Files of candidates: what is read, and the one line that says what cannot be."""

import io
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxgrasp.candidates import (
    CandidateError,
    Superquadric,
    concatenate,
    read_candidates,
    read_wrenches,
    sample_grasps,
)

rng = np.random.default_rng(0)


def columns(count=5, contacts=4, **others):
    normals = rng.normal(size=(count, contacts, 3))
    fields = {
        "positions": rng.normal(size=(count, contacts, 3)),
        "outward_normals": normals / np.linalg.norm(normals, axis=-1, keepdims=True),
        "friction": np.float64(0.5),
        "max_force": rng.uniform(1.0, 5.0, count),
    }
    return {name: value for name, value in (fields | others).items() if value is not None}


def save(path, **fields):
    np.savez(path, **fields)
    return path


def message_of(path, **options):
    with pytest.raises(CandidateError) as caught:
        read_candidates([path], **options)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(str(path))
    return line


def test_reads_what_is_there(tmp_path):
    fields = columns(mass=np.full(5, 0.2), center_of_mass=np.ones((5, 3)), label=np.array(list("abcde")))
    candidates = read_candidates([save(tmp_path / "a.npz", **fields)])
    assert len(candidates) == 5 and candidates.num_contacts == 4
    np.testing.assert_array_equal(candidates.positions, fields["positions"])
    np.testing.assert_array_equal(candidates.normals, fields["outward_normals"])
    np.testing.assert_array_equal(candidates.friction, np.full((5, 4), 0.5))
    np.testing.assert_array_equal(candidates.max_force, np.repeat(fields["max_force"][:, None], 4, axis=1))
    assert candidates.active.all()
    assert list(candidates.columns) == ["center_of_mass", "label"]
    assert candidates.sources == (str(tmp_path / "a.npz"),)


def test_a_column_of_n_is_per_candidate_even_where_n_is_n_c(tmp_path):
    fields = columns(count=4, contacts=4)
    candidates = read_candidates([save(tmp_path / "a.npz", **fields)])
    np.testing.assert_array_equal(candidates.max_force[:, 0], fields["max_force"])
    assert (candidates.max_force == candidates.max_force[:, :1]).all()


def test_options_fill_only_what_a_file_lacks(tmp_path):
    path = save(tmp_path / "a.npz", **columns(max_force=None))
    candidates = read_candidates([path], friction=0.9, max_force=7.0)
    assert (candidates.friction == 0.5).all() and (candidates.max_force == 7.0).all()


def test_frames_and_integers_and_big_endian(tmp_path):
    frames = np.broadcast_to(np.eye(3, dtype=np.int64), (5, 4, 3, 3))
    fields = columns(
        outward_normals=None, frames=frames, joints=np.ones((5, 2), dtype=">f8"), half=np.ones(5, np.float16)
    )
    candidates = read_candidates([save(tmp_path / "a.npz", **fields)])
    assert candidates.frames is not None and candidates.frames.dtype == np.float64
    np.testing.assert_array_equal(candidates.normals[0, 0], [0.0, 0.0, 1.0])
    assert candidates.columns["joints"].dtype == np.float64 and candidates.columns["half"].dtype == np.float64


def test_what_is_not_per_candidate_is_passed_over(tmp_path):
    path = save(tmp_path / "a.npz", **columns(version=np.int64(3), axes=np.ones(3)))
    assert read_candidates([path]).columns == {}


def test_several_files_are_padded_with_absent_contacts(tmp_path):
    first = save(tmp_path / "a.npz", **columns(3, 4, label=np.array(["x", "y", "z"]), score=np.arange(3)))
    second = save(tmp_path / "b.npz", **columns(2, 2, mass=np.ones(2)))
    both = read_candidates([first, second])
    assert both.positions.shape == (5, 4, 3)
    np.testing.assert_array_equal(both.active[3:], [[True, True, False, False]] * 2)
    np.testing.assert_array_equal(both.index, [0, 1, 2, 0, 1])
    np.testing.assert_array_equal(both.source, [0, 0, 0, 1, 1])
    np.testing.assert_array_equal(both.columns["label"], ["x", "y", "z", "", ""])
    np.testing.assert_array_equal(both.columns["score"], [0.0, 1.0, 2.0, np.nan, np.nan])
    np.testing.assert_array_equal(both.mass, [np.nan, np.nan, np.nan, 1.0, 1.0])


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (columns(outward_normals=None, frames=np.broadcast_to(np.eye(3), (5, 4, 3, 3)), label=None), "frames"),
        (columns(label=np.arange(5)), "label"),
        (columns(label=np.full((5, 2), "x")), "label"),
    ],
)
def test_files_that_do_not_go_together(tmp_path, second, words):
    first = save(tmp_path / "a.npz", **columns(label=np.full(5, "x")))
    with pytest.raises(CandidateError, match=words):
        read_candidates([first, save(tmp_path / "b.npz", **second)])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"positions": None}, ["positions", "no such column", "wanted"]),
        ({"positions": None, "position": np.ones((5, 4, 3))}, ["position:", "'positions'"]),
        ({"positions": None, "contact_positions": np.ones((5, 4, 3))}, ["positions:", "'contact_positions'"]),
        ({"outward_normals": None}, ["outward_normals", "frames"]),
        ({"outward_normals": None, "normals": np.ones((5, 4, 3))}, ["outward_normals:", "'normals'"]),
        ({"max_force": None, "max_forces": np.ones(5)}, ["max_forces:", "'max_force'"]),
        ({"max_force": None}, ["max_force", "--max-force"]),
        ({"friction": None}, ["friction", "--friction"]),
        ({"centre_of_mass": np.ones((5, 3))}, ["centre_of_mass:", "'center_of_mass'"]),
        ({"Active": np.ones((5, 4), bool)}, ["Active:", "'active'"]),
        ({"positions": np.ones((5, 4))}, ["positions", "(5, 4)", "(N, n_c, 3)"]),
        ({"positions": np.ones((5, 0, 3))}, ["positions", "(5, 0, 3)"]),
        ({"positions": np.ones((0, 4, 3))}, ["positions", "no candidates"]),
        ({"positions": np.full((5, 4, 3), "a")}, ["positions", "dtype <U1", "real numbers"]),
        ({"positions": np.ones((5, 4, 3), complex)}, ["positions", "complex128"]),
        ({"positions": np.full((5, 4, 3), None)}, ["positions", "Python objects"]),
        ({"notes": np.full(5, {}, dtype=object)}, ["notes", "Python objects"]),
        ({"outward_normals": np.ones((4, 4, 3))}, ["outward_normals", "(4, 4, 3)", "(5, 4, 3)"]),
        ({"frames": np.ones((5, 4, 3, 3))}, ["frames", "one of the two"]),
        ({"friction": np.ones(4)}, ["friction", "(4,)", "(5, 4)"]),
        ({"max_force": np.ones((5, 3))}, ["max_force", "(5, 3)", "(5, 4)"]),
        ({"mass": np.ones(3)}, ["mass", "(3,)", "(5,)"]),
        ({"active": np.ones((5, 4))}, ["active", "float64", "bool (5, 4)"]),
        ({"center_of_mass": np.ones((5, 2))}, ["center_of_mass", "(5, 2)", "(5, 3)"]),
        ({"when": np.full(5, "2020-01-01", "M8[D]")}, ["when", "datetime64"]),
        ({"impedance": np.ones(5, complex)}, ["impedance", "complex128"]),
    ],
)
def test_bad_fields_are_named(tmp_path, change, words):
    line = message_of(save(tmp_path / "a.npz", **columns(**change)))
    assert all(word in line for word in words), line


def test_gravity_needs_a_mass(tmp_path):
    path = save(tmp_path / "a.npz", **columns())
    assert "mass" in message_of(path, with_mass=True)
    assert np.isnan(read_candidates([path]).mass).all()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"positions: 1, 2, 3\n", "another kind"),
        (b"\x80\x04\x95pickle", "another kind"),
        (b"\x93NUMPY\x01\x00v\x00", "single .npy"),
    ],
)
def test_files_of_other_kinds(tmp_path, content, words):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    assert words in message_of(path)


def test_absent_files_and_folders(tmp_path):
    assert "no such file" in message_of(tmp_path / "none.npz")
    assert "directory" in message_of(tmp_path)


def test_archives_without_arrays(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert "no array" in message_of(path)


def whole_file():
    stream = io.BytesIO()
    np.savez_compressed(stream, **columns(mass=np.ones(5), label=np.full(5, "x")))
    return stream.getvalue()


WHOLE = whole_file()


@pytest.mark.parametrize("kept", [3, 4, 100, len(WHOLE) // 2, len(WHOLE) - 1])
def test_truncated_files(tmp_path, kept):
    path = tmp_path / "a.npz"
    path.write_bytes(WHOLE[:kept])
    message_of(path)


@settings(max_examples=300)
@given(places=st.lists(st.tuples(st.integers(0, len(WHOLE) - 1), st.integers(0, 255)), min_size=1, max_size=4))
def test_damaged_files_raise_nothing_else(tmp_path_factory, places):
    content = bytearray(WHOLE)
    for place, value in places:
        content[place] = value
    path = tmp_path_factory.mktemp("damaged", numbered=True) / "a.npz"
    path.write_bytes(content)
    try:
        read_candidates([path])
    except CandidateError as error:
        assert "\n" not in str(error)


def test_wrenches(tmp_path):
    wrenches = rng.normal(size=(7, 6))
    np.save(tmp_path / "w.npy", wrenches)
    np.savez(tmp_path / "w.npz", wrenches=wrenches)
    np.testing.assert_array_equal(read_wrenches(tmp_path / "w.npy"), wrenches)
    np.testing.assert_array_equal(read_wrenches(tmp_path / "w.npz"), wrenches)


@pytest.mark.parametrize(
    "wrenches",
    [
        np.ones(6),
        np.ones((2, 3)),
        np.ones((0, 6)),
        np.full((2, 6), np.nan),
        np.full((2, 6), None),
        np.full((2, 6), "a"),
    ],
)
def test_bad_wrenches(tmp_path, wrenches):
    np.save(tmp_path / "w.npy", wrenches)
    with pytest.raises(CandidateError, match="w.npy"):
        read_wrenches(tmp_path / "w.npy")
    np.savez(tmp_path / "w.npz", wrenches=wrenches)
    with pytest.raises(CandidateError, match="wrenches"):
        read_wrenches(tmp_path / "w.npz")


def test_wrenches_of_no_kind(tmp_path):
    (tmp_path / "w.npy").write_bytes(b"hello")
    with pytest.raises(CandidateError, match="w.npy"):
        read_wrenches(tmp_path / "w.npy")
    with pytest.raises(CandidateError, match="no such field"):
        read_wrenches(save(tmp_path / "w.npz", disturbances=np.ones((1, 6))))


def test_take_and_concatenate_are_inverse():
    grasps = sample_grasps(20)
    again = concatenate([grasps.take(slice(0, 7)), grasps.take(np.arange(7, 20))])
    np.testing.assert_array_equal(again.positions, grasps.positions)
    np.testing.assert_array_equal(again.index, grasps.index)


@pytest.mark.parametrize("exponent", [2.0, 4.0, 7.0])
def test_superquadric_points_and_normals(exponent):
    shape = Superquadric(exponent=exponent)
    directions = rng.normal(size=(200, 3))
    positions, normals = shape.surface(directions)

    def implicit(points):
        return (np.abs(points / np.array(shape.semi_axes)) ** exponent).sum(-1)

    np.testing.assert_allclose(implicit(positions), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(positions, directions), 0.0, atol=1e-12)
    step = 1e-7
    slope = np.stack([implicit(positions + step * axis) - implicit(positions - step * axis) for axis in np.eye(3)], -1)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    np.testing.assert_allclose(normals, slope, atol=1e-6)


def test_samples_repeat_with_their_seed():
    np.testing.assert_array_equal(sample_grasps(10).positions, sample_grasps(10).positions)
    assert (sample_grasps(10).positions != sample_grasps(10, seed=1).positions).all()
    np.testing.assert_array_equal(sample_grasps(10).positions, sample_grasps(10, friction=0.1).positions)
