"""LAS and LAZ: scale, unit, colours, and broken files."""

import pickle
import struct

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr

from pipeline.readers import open_scan
from pipeline.readers.attributes import decisions
from pipeline.readers.attributes.counts import over_all_points
from pipeline.readers.attributes.options import ReadOptions, canonical_station
from pipeline.readers.las import las
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.readers.shared_data import shared_scan

OFFSET = np.array([636_000.0, 4_800_000.0, -100.0])
SCALE = np.array([0.01, 0.001, 0.25])


def write(path, *, n=1000, point_format=3, color=None, intensity=True, wkt=None, version="1.2", source_id=None):
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.offsets, header.scales = OFFSET, SCALE
    if wkt:
        header.vlrs.append(WktCoordinateSystemVlr(wkt))
    scan = laspy.LasData(header)
    raw = np.random.default_rng(0).integers(-10_000, 10_000, (n, 3))
    scan.X, scan.Y, scan.Z = raw.T
    scan.intensity = np.arange(n) % 5000 if intensity else np.zeros(n)
    if source_id is not None:
        scan.point_source_id = source_id
    if color is not None:
        scan.red, scan.green, scan.blue = color
    scan.write(str(path))
    return path, raw * SCALE + OFFSET


def chunk_table_of(laz):
    """Where the chunk table begins, right after the points."""
    (start,) = struct.unpack_from("<I", laz, 96)
    return struct.unpack_from("<q", laz, start)[0]


def gather(source, max_points=300):
    pieces = list(source.pieces(max_points))
    columns = {k: [getattr(p, k) for p in pieces] for k in ("position", "color", "intensity")}
    return {k: None if v[0] is None else np.concatenate(v) for k, v in columns.items()}


@pytest.mark.parametrize("suffix", [".las", ".laz", ".LAZ"])
def test_las__positions_are_scaled_and_offset(tmp_path, suffix):
    path, position = write(tmp_path / f"a{suffix}")
    source = open_scan(path)
    got = gather(source)
    np.testing.assert_allclose(got["position"], position, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(got["intensity"], np.arange(1000))
    np.testing.assert_allclose(source.bounds, [position.min(axis=0), position.max(axis=0)], atol=1e-9)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las__piece_size_changes_nothing(tmp_path, suffix):
    source = open_scan(write(tmp_path / f"a{suffix}", color=np.ones((3, 1000)) * 4000)[0])
    whole = gather(source, 5000)
    for n in (7, 999, 1000):
        assert max(len(p.position) for p in source.pieces(n)) <= n
        for name, values in gather(source, n).items():
            np.testing.assert_array_equal(values, whole[name])


def test_las__16_bit_colours_are_scaled(tmp_path):
    color = np.zeros((3, 1000))
    color[:, 1:6] = [257, 257 * 100, 65535, 128, 129]
    source = open_scan(write(tmp_path / "a.las", color=color)[0])
    assert gather(source)["color"][:6, 0].tolist() == [0, 1, 100, 255, 0, 1]
    assert not any("8-bit" in w for w in source.warnings)


def test_las__8_bit_colours_in_16_bit_fields_are_kept_with_a_warning(tmp_path):
    color = np.arange(3000).reshape(3, 1000) % 256
    source = open_scan(write(tmp_path / "a.las", color=color)[0])
    np.testing.assert_array_equal(gather(source)["color"], color.T)
    assert any("8-bit values" in w for w in source.warnings)


def settled(source):
    """The scan as all of its points have it, and its points."""

    def pass_over(source, looks):
        for piece in source.pieces(300):
            looks.add(piece.look)
        return gather(source)

    return over_all_points(source, pass_over)


def test_las__colours_that_no_sample_saw_are_found_when_all_points_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(decisions, "PROBE_POINTS", 5)
    monkeypatch.setattr(decisions, "WHOLE", 100)
    color = np.zeros((3, 1000))
    color[:, 40:60] = 40_000
    sampled = open_scan(write(tmp_path / "a.las", color=color)[0])
    assert not sampled.has_colors and "sampled" in " ".join(sampled.warnings)
    source, got = settled(sampled)
    assert source.has_colors and got["color"][50].tolist() == [156, 156, 156]


def test_las__a_second_range_that_no_sample_saw_is_found_when_all_points_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(decisions, "PROBE_POINTS", 5)
    monkeypatch.setattr(decisions, "WHOLE", 100)
    color = np.full((3, 1000), 200)
    color[1, 640:660] = 60_000
    source, got = settled(open_scan(write(tmp_path / "a.las", color=color)[0]))
    assert got["color"][650, 1] == 233 and "65535" not in " ".join(source.warnings)


def test_las__a_few_values_beyond_8_bits_are_clipped_and_said(tmp_path):
    color = np.arange(3000).reshape(3, 1000) % 256
    color[1, 650] = 300
    source = open_scan(write(tmp_path / "a.las", color=color)[0])
    assert gather(source)["color"][650].tolist() == [color[0, 650], 255, color[2, 650]]
    assert "1 values beyond" in " ".join(source.warnings)


def test_las__colours_and_intensity_of_zeros_are_not_used(tmp_path):
    source = open_scan(write(tmp_path / "a.las", color=np.zeros((3, 1000)), intensity=False)[0])
    assert not source.has_colors and not source.has_intensity
    assert gather(source)["color"] is None and gather(source)["intensity"] is None
    assert sum("all points" in w for w in source.warnings) == 2


def test_las__formats_without_colour_have_intensity(tmp_path):
    source = open_scan(write(tmp_path / "a.las", point_format=0)[0])
    assert not source.has_colors and source.has_intensity


@pytest.mark.parametrize(
    ("wkt", "unit", "warning"),
    [
        ('PROJCS["p",GEOGCS["g",UNIT["degree",0.017]],UNIT["US survey foot",0.304800609601219]]', "US survey foot", ""),
        ('GEOGCS["g",UNIT["degree",0.017]]', "degree", "degrees"),
        (None, "unknown", "unit is unknown"),
    ],
)
def test_las__unit_comes_from_the_coordinate_system(tmp_path, wkt, unit, warning):
    source = open_scan(write(tmp_path / "a.las", wkt=wkt, point_format=7, version="1.4")[0])
    assert source.unit == unit
    assert warning in " ".join(source.warnings)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las__every_truncation_is_refused_at_open(tmp_path, suffix):
    whole = write(tmp_path / f"a{suffix}", n=60)[0].read_bytes()
    cut = tmp_path / f"cut{suffix}"
    table = chunk_table_of(whole) if suffix == ".laz" else len(whole)
    for n in [*range(0, table, 37), table - 1]:
        cut.write_bytes(whole[:n])
        with pytest.raises(InvalidScan, match="cut"):
            open_scan(cut)


def test_las__names_the_chunk_table_that_a_truncated_laz_lacks(tmp_path):
    whole = write(tmp_path / "a.laz", n=60)[0].read_bytes()
    table = chunk_table_of(whole)
    (tmp_path / "cut.laz").write_bytes(whole[:table])
    with pytest.raises(InvalidScan, match=f"a chunk table at byte {table} in a file of {table}"):
        open_scan(tmp_path / "cut.laz")


def test_las__a_laz_without_the_end_of_its_chunk_table_gives_its_points_or_an_error(tmp_path):
    whole = write(tmp_path / "a.laz", n=60)[0].read_bytes()
    cut = tmp_path / "cut.laz"
    for n in range(chunk_table_of(whole) + 1, len(whole)):
        cut.write_bytes(whole[:n])
        try:
            assert len(gather(open_scan(cut))["position"]) == 60
        except InvalidScan:
            pass


def test_las__altered_bytes_never_escape_as_another_error(tmp_path):
    whole = write(tmp_path / "a.laz", n=300)[0].read_bytes()
    bad, random, n_refused = tmp_path / "bad.laz", np.random.default_rng(0), 0
    for _ in range(150):
        content = bytearray(whole)
        for at in random.integers(100, len(whole), 3):
            content[at] = random.integers(0, 256)
        bad.write_bytes(content)
        try:
            gather(open_scan(bad))
        except InvalidScan:
            n_refused += 1
    assert n_refused > 10


def test_las__a_panic_of_the_decoder_is_an_invalid_scan(tmp_path, monkeypatch):
    class PanicException(BaseException):
        pass

    def panic(*_):
        raise PanicException("index out of bounds")

    path = write(tmp_path / "a.laz")[0]
    monkeypatch.setattr(las._Packed, "read", panic)
    with pytest.raises(InvalidScan, match="unreadable: its compressed points are damaged"):
        las.open_las(str(path))


def test_las__an_interrupt_is_not_an_invalid_scan(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    path = write(tmp_path / "a.laz")[0]
    monkeypatch.setattr(las._Packed, "read", interrupt)
    with pytest.raises(KeyboardInterrupt):
        las.open_las(str(path))


@pytest.mark.parametrize("value", [0.0, float("nan"), float("inf")])
def test_las__refuses_a_scale_that_is_none(tmp_path, value):
    path = write(tmp_path / "a.las")[0]
    content = bytearray(path.read_bytes())
    content[131:139] = np.float64(value).tobytes()
    path.write_bytes(content)
    with pytest.raises(InvalidScan, match="scale"):
        open_scan(path)


def test_las__refuses_an_empty_scan_and_a_file_of_another_kind(tmp_path):
    with pytest.raises(InvalidScan, match="0 points"):
        open_scan(write(tmp_path / "a.las", n=0)[0])
    (tmp_path / "b.las").write_bytes(b"ply\n" * 200)
    with pytest.raises(InvalidScan, match="b.las"):
        open_scan(tmp_path / "b.las")


def test_las__source_can_be_sent_to_another_process(tmp_path):
    source = open_scan(write(tmp_path / "a.laz")[0])
    np.testing.assert_array_equal(gather(pickle.loads(pickle.dumps(source)))["position"], gather(source)["position"])


def test_las__autzen_is_in_feet_with_8_bit_colours():
    source = open_scan(shared_scan("autzen_rgb_statefeet/autzen_trim.las"))
    got = gather(source, 40_000)
    assert source.n_points == len(got["position"]) == 110_000 and source.unit == "foot"
    np.testing.assert_allclose(got["position"].min(axis=0), [636001.76, 848935.2, 406.26], atol=1e-6)
    np.testing.assert_allclose(got["position"].max(axis=0), [637179.22, 849497.9, 520.51], atol=1e-6)
    assert got["color"].max() == 236 and any("8 bits: all 330,000 values above 0" in w for w in source.warnings)


def test_las__spruce_is_read_from_laz():
    source = open_scan(shared_scan("tree_spruce_tls/spruce.laz"))
    position = gather(source, 40_000)["position"]
    assert source.n_points == len(position) == 83_392 and not source.has_colors
    np.testing.assert_allclose(np.ptp(position, axis=0), [2.49, 2.49, 16.94], atol=1e-3)
    assert len(position) - len(np.unique(position, axis=0)) == 3242


@pytest.mark.parametrize("suffix, point_format, version", [(".las", 1, "1.2"), (".laz", 3, "1.2"), (".las", 7, "1.4")])
def test_las__point_source_ids_tell_stations_apart_where_positions_are_given(tmp_path, suffix, point_format, version):
    ids = np.repeat([3, 9, 4], [300, 500, 200])
    path, _ = write(tmp_path / f"a{suffix}", point_format=point_format, version=version, source_id=ids)
    source = open_scan(path, ReadOptions(station="9=1,2,3; 3 = 0,0,5;12=7,7,7"))
    assert source.stations == ((0, 0, 5), (1, 2, 3), (7, 7, 7))
    for pieces in (source.pieces(170), source.read_slice(0, 1000, 333)):
        found = np.concatenate([p.station for p in pieces])
        np.testing.assert_array_equal(found, np.select([ids == 3, ids == 9], [0, 1], -1))
    told = "\n".join(source.warnings)
    assert (
        "point source ids [12], which stations" in told
        and "no station is known of points with the point source ids [4]" in told
    )
    assert "point source id" in open_scan(path).unused and "point source id" not in source.unused
    assert open_scan(path).stations == () and open_scan(path).details["point_source_ids"] == [3, 4, 9]


def test_las__stations_by_point_source_id_are_refused_where_there_are_none(tmp_path):
    path = tmp_path / "a.xyz"
    np.savetxt(path, np.random.default_rng(0).normal(size=(50, 3)))
    with pytest.raises(UnsupportedScan, match="no point source ids"):
        open_scan(path, ReadOptions(station="9=1,2,3"))


@pytest.mark.parametrize("text", ["1=2,3", "a=1,2,3", "1=1,2,3;1=4,5,6", "70000=0,0,0", "-1=0,0,0", "1=1,2,inf"])
def test_station__by_point_source_id_is_canonical_or_refused(text):
    assert canonical_station("7=1, 2,3.0 ;2=0,0,0;") == "2=0,0,0;7=1,2,3"
    with pytest.raises(ValueError, match="allowed: three finite numbers"):
        canonical_station(text)
