import numpy as np
import pytest

from pipeline.geometry.normals import decode_normals, encode_normals, octahedron_of
from tests.reference_packed import every_normal

AXES = np.concatenate([np.eye(3), -np.eye(3)])


def angle_degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(2 * np.arcsin(np.linalg.norm(a - b, axis=1) / 2))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def random_normals(n: int) -> np.ndarray:
    return unit(np.random.default_rng(0).standard_normal((n, 3)))


def near_poles(n: int) -> np.ndarray:
    """Normals at 1e-12 to 0.1 from the six axes."""
    rng = np.random.default_rng(1)
    away = rng.standard_normal((n, 3)) * 10 ** rng.uniform(-12, -1, (n, 1))
    return unit(AXES[rng.integers(0, 6, n)] + away)


def near_folds(n: int) -> np.ndarray:
    """Normals beside the edges of the octahedron, where its map is folded, and beside its face centres."""
    rng = np.random.default_rng(2)
    edge = rng.uniform(-1, 1, (n, 3)) * np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]])[rng.integers(0, 3, n)]
    face = rng.choice([-1.0, 1.0], (n, 3))
    return unit(np.concatenate([edge, face]) + rng.standard_normal((2 * n, 3)) * 1e-3)


@pytest.mark.parametrize(
    "normal",
    [random_normals(200_000), near_poles(20_000), near_folds(20_000)],
    ids=["random", "near poles", "near folds"],
)
def test_normals__come_back_within_064_degrees(normal):
    assert angle_degrees(decode_normals(encode_normals(normal)), normal).max() <= 0.64


def test_normals__come_back_within_032_degrees_on_average():
    normal = random_normals(200_000)
    assert angle_degrees(decode_normals(encode_normals(normal)), normal).mean() <= 0.32


def test_normals__no_other_code_is_nearer():
    code, all_normals = every_normal()
    normal = np.concatenate([random_normals(300), near_poles(100), near_folds(50)])
    found = (decode_normals(encode_normals(normal)) * normal).sum(axis=1)
    assert (found >= (normal @ all_normals.T).max(axis=1) - 1e-15).all()


def test_normals__axes_come_back_exactly():
    assert (decode_normals(encode_normals(AXES)) == AXES).all()
    assert (decode_normals(encode_normals(AXES * [1, 1, -1])) == AXES * [1, 1, -1]).all()  # with signed zeros


def test_normals__every_code_decodes_as_the_real_valued_map_does():
    code, normal = every_normal()
    assert len(code) == 65_025
    np.testing.assert_allclose(decode_normals(code), normal, atol=1e-14)


def test_normals__every_direction_that_has_a_code_comes_back_exactly():
    code, _ = every_normal()
    normal = decode_normals(code)
    assert (decode_normals(encode_normals(normal)) == normal).all()


def test_normals__octahedron_is_in_whole_numbers():
    code, _ = every_normal()
    point = octahedron_of(code)
    assert point.dtype == np.int32
    assert (np.abs(point).sum(axis=1) == 127).all()


def test_normals__least_code_is_minus_127():
    assert encode_normals(np.concatenate([random_normals(50_000), AXES])).min() == -127


def test_normals__length_and_type_do_not_matter():
    normal = random_normals(1000)
    assert (encode_normals(normal * 7) == encode_normals(normal)).all()
    read_only = normal.astype(np.float32)
    read_only.setflags(write=False)
    assert angle_degrees(decode_normals(encode_normals(read_only)), normal).max() <= 0.64


def test_normals__none_have_no_codes():
    assert encode_normals(np.zeros((0, 3))).shape == (0, 2)
    assert decode_normals(np.zeros((0, 2), np.int8)).shape == (0, 3)
