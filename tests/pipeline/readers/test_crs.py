"""Units out of WKT 1, WKT 2 and GeoTIFF keys."""

import pytest

from pipeline.readers.las.crs import DEGREE, FOOT, METRE, UNKNOWN, US_FOOT, unit_from_geokeys, unit_from_wkt

GEOGCS = 'GEOGCS["NAD83",DATUM["D",SPHEROID["GRS 1980",6378137,298.25]],UNIT["degree",0.0174532925199433]]'


def projcs(unit):
    return f'PROJCS["any, [name]",{GEOGCS},PROJECTION["Mercator"],PARAMETER["scale",1],{unit},AXIS["X",EAST]]'


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ('UNIT["metre",1,AUTHORITY["EPSG","9001"]]', METRE),
        ('UNIT["Meter",1.0]', METRE),
        ('UNIT["foot",0.3048]', FOOT),
        ('UNIT["Foot_US",0.3048006096012192]', US_FOOT),
        ('UNIT["US survey foot",0.304800609601219]', US_FOOT),
        ('UNIT["link",0.201168]', "link (0.201168 m)"),
        ('UNIT["broken",word]', UNKNOWN),
        ('UNIT["broken",0]', UNKNOWN),
        ("", UNKNOWN),
    ],
)
def test_crs__wkt1_gives_the_unit_of_the_projection_not_of_the_angles(unit, expected):
    assert unit_from_wkt(projcs(unit)) == expected
    vertical = 'VERT_CS["h",VERT_DATUM["v",2005],UNIT["furlong",201]]'
    assert unit_from_wkt(f'COMPD_CS["both",{projcs(unit)},{vertical}]') == expected


def test_crs__wkt2_gives_the_unit_beside_or_inside_the_axes():
    base = 'BASEGEOGCRS["W",DATUM["W",ELLIPSOID["W",6378137,298,LENGTHUNIT["metre",1]]]]'
    conversion = 'CONVERSION["c",PARAMETER["False easting",0,LENGTHUNIT["metre",1]]]'
    foot = 'LENGTHUNIT["US survey foot",0.304800609601219]'
    inside = f'PROJCRS["p",{base},{conversion},CS[Cartesian,2],AXIS["E",east,{foot}],AXIS["N",north,{foot}]]'
    beside = f'PROJCRS["p",{base},{conversion},CS[Cartesian,2],AXIS["E",east],AXIS["N",north],{foot}]'
    assert unit_from_wkt(inside) == unit_from_wkt(beside) == US_FOOT


def test_crs__geographic_systems_are_in_degrees():
    assert unit_from_wkt(GEOGCS) == DEGREE
    assert unit_from_geokeys({1024: 2}) == DEGREE


@pytest.mark.parametrize("wkt", ["", "]]]", '"', "PROJCS[" * 100_000, "PROJCS", "LOCAL_CS[]"])
def test_crs__nonsense_is_unknown(wkt):
    assert unit_from_wkt(wkt) == UNKNOWN


@pytest.mark.parametrize(
    ("keys", "size", "expected"),
    [
        ({1024: 1, 3076: 9001}, None, METRE),
        ({3076: 9002}, None, FOOT),
        ({3076: 9003}, None, US_FOOT),
        ({3076: 32767}, 0.3048, FOOT),
        ({3076: 32767}, None, UNKNOWN),
        ({3072: 32633}, None, METRE),
        ({3072: 2285}, None, US_FOOT),
        ({3072: 65000}, None, UNKNOWN),
        ({}, None, UNKNOWN),
    ],
)
def test_crs__geokeys(keys, size, expected):
    assert unit_from_geokeys(keys, size) == expected
