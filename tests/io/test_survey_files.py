# SPDX-License-Identifier: BSD-3-Clause
"""Files of positions, control points and distances: every layout, and what is said of those that do not fit.

The truth of coordinates is geometry on the ellipsoid; of EXIF it is a block written here by the standard.
"""

import json
import struct

import numpy as np
import pytest

from groma.errors import FileFormatError, InputError
from groma.io.survey import (
    CoordinateSystem,
    Places,
    common_frame,
    read_control,
    read_distances,
    read_exif_positions,
    read_positions,
)
from groma.io.survey.coordinates import geocentric


def written(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "sigma"),
    [
        ("a.jpg 1 2 3\nb.jpg 4 5 6\n", None),
        ("a.jpg,1,2,3,0.1\nb.jpg,4,5,6,0.2\n", [[0.1] * 3, [0.2] * 3]),
        ("# by hand\na.jpg;1;2;3;.1;.2;.3\nb.jpg;4;5;6;.1;.2;.4\n", [[0.1, 0.2, 0.3], [0.1, 0.2, 0.4]]),
        ("z,Image Name,Y (m),x,accuracy\n3,a.jpg,2,1,.5\n6,b.jpg,5,4,.7\n", [[0.5] * 3, [0.7] * 3]),
        (
            "name\teasting\tnorthing\theight\tsh\tsv\na.jpg\t1\t2\t3\t.1\t.2\nb.jpg\t4\t5\t6\t.1\t.2\n",
            [[0.1, 0.1, 0.2]] * 2,
        ),
    ],
)
def test_positions_in_the_usual_layouts(tmp_path, text, sigma):
    found = read_positions(written(tmp_path, "positions.csv", text))
    assert found.names == ("a.jpg", "b.jpg") and found.system.is_local
    np.testing.assert_array_equal(found.coordinates, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(found.sigma, np.full((2, 3), np.nan) if sigma is None else sigma)


@pytest.mark.parametrize(
    ("text", "sigma"),
    [
        ("#Rev: senseFly\nfileName\tlatitude\tlongitude\taltitude_amsl\taltitude_wgs84\na.jpg\t2\t1\t3\t40\n", ()),
        ("imagename,latitude [dd],longitude [dd],altitude [meter],accuracy horizontal [m],accuracy vertical [m]\n"
         "a.jpg,2,1,3,.1,.2\n", (0.1, 0.1, 0.2)),
        ("imagename,latitude,longitude,altitude,omega,Accuracy Easting [m],Accuracy Northing [m],Accuracy Vert [m]\n"
         "a.jpg,2,1,3,9,.1,.2,.3\n", (0.1, 0.2, 0.3)),
        ("SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\na.jpg,2,1,3\n", ()),
        ("#Label,Longitude,Latitude,Altitude,Accuracy_X/Y_(m),Accuracy_Z_(m)\na.jpg,1,2,3,.1,.2\n", (0.1, 0.1, 0.2)),
        ("#CoordinateSystem: WGS 84 (EPSG::4326)\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Accuracy_X_(m),"
         "Accuracy_Y_(m),Accuracy_Z_(m)\na.jpg,1,2,3,90,.1,.2,.3\n", (0.1, 0.2, 0.3)),
        ("#System: WGS 84 (EPSG::4326)\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_(m)\na.jpg,1,2,3,,\n", ()),
    ],
)  # fmt: skip
def test_degrees_in_the_layouts_of_other_programs(tmp_path, text, sigma):
    """Of senseFly, Pix4D, ExifTool and Metashape; a field that is left empty states nothing."""
    found = read_positions(written(tmp_path, "positions.csv", text))
    assert found.names == ("a.jpg",) and found.system.is_geographic and found.coordinates.tolist() == [[1, 2, 3]]
    np.testing.assert_array_equal(found.sigma, [sigma or [np.nan] * 3])


def test_hemispheres_and_well_known_text(tmp_path):
    text = "name,GPSLatitude,GPSLatitudeRef,GPSLongitude,GPSLongitudeRef,z\na.jpg,2,South,1,W,3\nb.jpg,2,N,-1,W,3\n"
    found = read_positions(written(tmp_path, "exiftool.csv", text))
    assert found.coordinates.tolist() == [[-1, -2, 3], [-1, 2, 3]]
    unit, code = 'UNIT["metre",1,AUTHORITY["EPSG","9001"]]', 'AUTHORITY["EPSG","32632"]'
    rows = "#Label X/Easting Y/Northing Z/Altitude Omega Phi Kappa\na.jpg 593656.5 5089108.8 909.4 69.8 -11.2 -4.5\n"
    found = read_positions(written(tmp_path, "wkt.txt", f'# CoordinateSystem: PROJCS["UTM",{unit},{code}]\n{rows}'))
    assert found.system.name == "EPSG:32632" and np.isnan(found.sigma).all()
    assert found.coordinates.tolist() == [[593656.5, 5089108.8, 909.4]]
    assert read_positions(written(tmp_path, "own.txt", f'# LOCAL_CS["own",{unit}]\n{rows}')).system.is_local


def test_a_header_in_a_comment_tells_angles_from_standard_deviations(tmp_path):
    text = "#name,x,y,alt,heading,pitch,roll\na.jpg,1,2,3,90,5,7\n"
    found = read_positions(written(tmp_path, "reality.csv", text))
    assert found.coordinates.tolist() == [[1, 2, 3]] and np.isnan(found.sigma).all() and found.system.is_local


def test_numbers_that_look_like_degrees_need_their_name(tmp_path):
    rows = "a.jpg,37.5448,139.0398,216.6\nb.jpg,37.5449,139.0399,216.9\n"
    for text in (rows, "name,x,y,z\n" + rows):
        with pytest.raises(FileFormatError, match=r"heights by 0\.3: they look like degrees\. Name the columns"):
            read_positions(written(tmp_path, "positions.csv", text))
    assert read_positions(written(tmp_path, "positions.csv", "local\n" + rows)).system.is_local
    for text in ("a 1 2 3\nb 1.01 2.01 3.001\n", "a 1 2 3\nb 1.5 2.5 9\n", "a 99 98 3\nb 99.1 98.1 9\n", "a 1 2 3\n"):
        assert read_positions(written(tmp_path, "positions.csv", text)).system.is_local


def test_geo_txt_of_opendronemap(tmp_path):
    text = "EPSG:32617\na.jpg 500000.5 4e6 100 1 2 3 0.03 0.05\nb.jpg 500010 4000010 101\nc.jpg 500020 4000020\n"
    found = read_positions(written(tmp_path, "geo.txt", text))
    assert found.system.name == "EPSG:32617" and not found.system.is_geographic
    assert found.coordinates[0].tolist() == [500000.5, 4e6, 100.0]
    assert found.sigma[0].tolist() == [0.03, 0.03, 0.05] and np.isnan(found.sigma[1]).all()
    assert "1 position without a height" in found.notes[0]


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("EPSG: 32611", "EPSG:32611"),
        ("WGS84 UTM 11N", "EPSG:32611"),
        ("UTM zone 33 S", "EPSG:32733"),
        ("+proj=utm +zone=11 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", "EPSG:32611"),
        ("+proj=utm +zone=33 +south +datum=WGS84", "EPSG:32733"),
        ("local", ""),
    ],
)
def test_names_of_coordinate_systems(line, name):
    assert CoordinateSystem.parse(line) == CoordinateSystem(name)


def test_lines_that_name_no_system():
    assert CoordinateSystem.parse("a.jpg 1 2 3") is None
    assert CoordinateSystem.parse("+proj=longlat +datum=WGS84").is_geographic


def places(coordinates, system="EPSG:4326"):
    coordinates = np.array(coordinates, float)
    names = tuple(map(str, range(len(coordinates))))
    return Places(names, coordinates, np.ones_like(coordinates), CoordinateSystem(system), "positions.csv")


def test_longitudes_and_latitudes_become_metres():
    """Distances are those in space, up is away from the ellipsoid, and a minute of latitude is a nautical mile."""
    rng = np.random.default_rng(2)
    given = np.column_stack(
        [13.4 + rng.normal(size=9) * 1e-3, 52.5 + rng.normal(size=9) * 1e-3, rng.normal(size=9) * 40]
    )
    (xyz,), frame = common_frame([places(given)])
    far = np.linalg.norm(xyz[1:] - xyz[:-1], axis=1)
    np.testing.assert_allclose(far, np.linalg.norm(np.diff(geocentric(given), axis=0), axis=1), atol=1e-8)
    assert "longitude" in frame.description and frame.origin[0] == pytest.approx(13.4, abs=1e-3)
    at = np.array([[10.0, 45.0, 0.0], [10.0, 45.0 + 1 / 60, 0.0], [10.0, 45.0, 100.0], [10.0 + 1 / 60, 45.0, 0.0]] * 2)
    (xyz,), _ = common_frame([places(at)])
    np.testing.assert_allclose(xyz[2] - xyz[0], [0, 0, 100], atol=0.05)
    assert np.linalg.norm(xyz[1] - xyz[0]) == pytest.approx(1852, abs=2)
    reduced = np.arctan((1 - 1 / 298.257223563) * np.tan(np.radians(45)))  # the circle of latitude has the radius a cos
    assert np.linalg.norm(xyz[3] - xyz[0]) == pytest.approx(6378137 * np.cos(reduced) * np.pi / 10800, abs=1e-3)


def test_projected_coordinates_stay_as_written():
    group = places([[600000.123456789, 5400000.987654321, 7.5]] * 2, "EPSG:32632")
    (xyz,), frame = common_frame([group])
    assert np.array_equal(xyz, group.coordinates) and frame.description == "UTM zone 32 north (EPSG:32632)"


def test_geographic_and_projected_places_meet():
    """UTM by pyproj against the length of arcs: at the central meridian the scale is 0.9996."""
    pytest.importorskip("pyproj")
    line = places([[9.0, 48.0, 0.0], [9.0, 48.01, 0.0]])
    (xyz, other), frame = common_frame([line, places([[500000, 5316000, 0]] * 2, "EPSG:32632")])
    assert frame.system == "EPSG:32632" and np.allclose(other[:, 0], 500000)
    length = np.linalg.norm(np.diff(geocentric(line.coordinates), axis=0))
    assert np.linalg.norm(xyz[1] - xyz[0]) == pytest.approx(0.9996 * length, rel=1e-6)
    assert np.allclose(xyz[:, 0], 500000, atol=1e-6)
    assert common_frame([line], "utm")[1].system == "EPSG:32632"


def test_marks_of_points_without_a_place_say_nothing_of_the_frame():
    marks, known = places([[np.nan] * 3] * 2), places([[600000.0, 5400000.0, 7.0]] * 2, "EPSG:32632")
    (xyz, none), frame = common_frame([known, marks])
    assert frame.system == "EPSG:32632" and np.array_equal(xyz, known.coordinates) and np.isnan(none).all()
    (none,), frame = common_frame([marks])
    assert frame.description == "the frame of the scene" and np.isnan(none).all()


def test_without_pyproj_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyproj", None)
    with pytest.raises(InputError, match=r'pip install "groma\[geo\]"'):
        common_frame([places([[9.0, 48.0, 0.0]] * 2)], "utm")


@pytest.mark.parametrize("mark", [" ", ";", "\t"])
def test_decimal_commas_are_named(tmp_path, mark):
    (tmp_path / "p.txt").write_text(mark.join(["a.jpg", "4,25", "-5,5", "6,0", "0,02"]))
    with pytest.raises(FileFormatError, match="has decimal commas"):
        read_positions(tmp_path / "p.txt")
    (tmp_path / "p.txt").write_text("a.jpg, 4, 5, 6\nb.jpg; 4; 5; 7")
    assert read_positions(tmp_path / "p.txt").coordinates.tolist() == [[4, 5, 6], [4, 5, 7]]


def test_a_system_that_cannot_be_checked_is_told(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyproj", None)
    group = places([[600000.0, 5400000.0, 7.5]] * 2, "EPSG:99999")
    assert "EPSG:99999 (as written; whether there is such" in common_frame([group])[1].description


def test_a_system_that_does_not_exist_is_refused():
    pytest.importorskip("pyproj")
    group = places([[600000.0, 5400000.0, 7.5]] * 2, "EPSG:99999")
    with pytest.raises(InputError, match="knows no coordinate system EPSG:99999"):
        common_frame([group])
    feet = places([[6000000.0, 2100000.0, 7.5]] * 2, "EPSG:2227")
    assert common_frame([feet])[1].description.endswith("(EPSG:2227, US survey foot)")


@pytest.mark.parametrize(
    ("coordinates", "system", "words"),
    [
        ([[48.1, 122.0, 0.0]] * 3, "EPSG:4326", "exchanged"),
        ([[500000.0, 5300000.0, 0.0]] * 3, "EPSG:4326", "metres, not degrees"),
        ([[13.4001, 52.5001, 30], [13.4002, 52.5002, 31], [13.4005, 52.5001, 32]], "", "look like degrees"),
    ],
)
def test_units_that_cannot_be(coordinates, system, words):
    with pytest.raises(InputError, match=words):
        common_frame([places(coordinates, system)])


def test_local_and_known_systems_do_not_mix():
    with pytest.raises(InputError, match="does not say its coordinate"):
        common_frame([places([[1, 2, 3]], ""), places([[500000, 5300000, 0]], "EPSG:32632")])


@pytest.mark.parametrize(
    "places, said",
    [
        (["1 2 70", "1 2 70.5", "3 4 71"], "points that differ in height alone: (1, 2, 70) and (1, 2, 70.5). If they"),
        (["1 2 70", "1 3 70", "3 4 70"], "all 3 control points have the height 70; it was hardly measured"),
        (["1 2 70", "1 3 71", "3 2 72", "- - -"], None),
    ],
)
def test_heights_that_are_doubtful_are_told(tmp_path, places, said):
    text = "".join(f"{place} 5 6 a.jpg\n" for place in places)
    notes = read_control(written(tmp_path, "gcp_list.txt", "EPSG:32611\n" + text)).places.notes
    assert len(notes) == (said is not None) and all(said in note for note in notes)


def test_gcp_list_of_opendronemap(tmp_path):
    text = (
        "WGS84 UTM 11N\n235269.88\t3811198.11\t0.0\t1203.0\t764.0\tIMG_0037.JPG\tgcp02\n"
        "235269.88 3811198.11 0 196 342 IMG_0121.JPG gcp02\n235262.54 3811203.5 0 1 2 a.jpg\n- - - 5 6 a.jpg bar\n"
        "235263.54 3811203.5 0 1 2 a.jpg\n"
    )
    found = read_control(written(tmp_path, "gcp_list.txt", text))
    assert found.places.names[0] == "gcp02" and found.places.names[2] == "bar" and len(found.places.names) == 4
    assert found.pixels[0].tolist() == [1203.5, 764.5] and not found.normalized
    assert found.point_idx.tolist() == [0, 0, 1, 2, 3] and found.image_names[1] == "IMG_0121.JPG"
    assert np.isnan(found.places.coordinates[2]).all() and "height 0" in found.places.notes[0]


def test_control_points_of_opensfm(tmp_path):
    seen = [{"shot_id": "02.jpg", "projection": [-0.25, 0.125]}]
    position = {"latitude": 52.5, "longitude": 13.4, "altitude": 15.0}
    points = [
        {"id": "0", "position": position, "observations": seen},
        {"id": "1", "role": "check", "observations": seen},
    ]
    found = read_control(written(tmp_path, "gcp.json", json.dumps({"points": points})))
    assert found.places.names == ("0", "1") and found.places.system.is_geographic and found.normalized
    assert found.places.coordinates[0].tolist() == [13.4, 52.5, 15.0] and np.isnan(found.places.coordinates[1]).all()
    assert found.is_check.tolist() == [False, True] and found.pixels[0].tolist() == [-0.25, 0.125]


def test_distances(tmp_path):
    found = read_distances(written(tmp_path, "bars.csv", "from,to,distance,sigma\na,b,1.5,0.001\nb,c,2\n"))
    assert found.first == ("a", "b") and found.distance.tolist() == [1.5, 2.0]
    assert found.sigma[0] == 0.001 and np.isnan(found.sigma[1])


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (read_positions, "a.jpg 1 2\n", "line 1: expected name, x, y, z"),
        (read_positions, "a.jpg 1 2 nan\n", "nan"),
        (read_positions, "a.jpg 1 2 3\na.jpg 1 2 3\n", "position already"),
        (read_positions, "a.jpg 1 2 3 4 5\n", "one or three standard deviations"),
        (read_positions, "name,x,y\na,1,2\n", "no column for z"),
        (read_positions, "name,x,y,z\na,1,2\n", "expected 4 columns"),
        (read_positions, "\n", "holds no position"),
        (read_control, "1 2 3 4 5 a.jpg\n", "line 1: expected a coordinate system"),
        (read_control, "EPSG:32611\n1 2 3 4 a.jpg\n", "line 2: expected x y z u v image"),
        (read_control, "EPSG:32611\n1 2 3 4 5 a.jpg p\n1 2 4 4 5 b.jpg p\n", "other coordinates before"),
        (read_control, "EPSG:32611\n", "no mark"),
        (read_control, '{"points": [{"id": "1", "observations": [{"shot_id": "a", "projection": [1]}]}]}', "2 finite"),
        (read_control, '{"points": 3}', "a list"),
        (read_distances, "a b 0\n", "must be positive"),
        (read_distances, "a b 1 2 3\n", "name name distance sigma"),
    ],
)
def test_damaged_files(tmp_path, read, text, words):
    with pytest.raises(FileFormatError, match=words):
        read(written(tmp_path, "file", text))


def tiff_with_position(order, latitude, longitude, altitude, below=0, before=0, error=np.nan):
    """A TIFF structure that holds a position, by the standard: two directories, after other bytes, and their values."""

    def rationals(values):
        pairs = ((0, 0) if np.isnan(value) else (round(value * 10000), 10000) for value in values)
        return b"".join(struct.pack(order + "II", *pair) for pair in pairs)

    def degrees(value):
        whole = int(abs(value))
        minutes = (abs(value) - whole) * 60
        return rationals([whole, int(minutes), (minutes - int(minutes)) * 60])

    gps_at, count = 26 + before, 7
    values_at = gps_at + 2 + 12 * count + 4
    entries = [
        (1, 2, 2, (b"N" if latitude >= 0 else b"S") + b"\0\0\0"), (2, 5, 3, struct.pack(order + "I", values_at)),
        (3, 2, 2, (b"E" if longitude >= 0 else b"W") + b"\0\0\0"), (4, 5, 3, struct.pack(order + "I", values_at + 24)),
        (5, 1, 1, bytes([below, 0, 0, 0])), (6, 5, 1, struct.pack(order + "I", values_at + 48)),
        (31, 5, 1, struct.pack(order + "I", values_at + 56)),
    ]  # fmt: skip
    tiff = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8 + before) + bytes(before)
    tiff += (
        struct.pack(order + "H", 1) + struct.pack(order + "HHII", 0x8825, 4, 1, gps_at) + struct.pack(order + "I", 0)
    )
    tiff += struct.pack(order + "H", count)
    tiff += b"".join(struct.pack(order + "HHI", tag, kind, number) + value for tag, kind, number, value in entries)
    return tiff + struct.pack(order + "I", 0) + degrees(latitude) + degrees(longitude) + rationals([altitude, error])


def jpeg_with_position(*position, **more):
    """A JPEG head whose EXIF holds a position."""
    body = b"Exif\0\0" + tiff_with_position(*position, **more)
    return b"\xff\xd8\xff\xe0\0\x04ab\xff\xe1" + struct.pack(">H", len(body) + 2) + body + b"\xff\xda"


@pytest.mark.parametrize("order", ["<", ">"])
def test_positions_in_exif(tmp_path, order):
    (tmp_path / "a.jpg").write_bytes(jpeg_with_position(order, -34.5, 151.25, 12.5, below=1))
    (tmp_path / "b.jpg").write_bytes(jpeg_with_position(order, 52.51926, -13.4007, 99))
    (tmp_path / "none.jpg").write_bytes(b"\xff\xd8\xff\xda")
    found = read_exif_positions(tmp_path, ["a.jpg", "b.jpg", "none.jpg", "missing.jpg"])
    assert found.names == ("a.jpg", "b.jpg") and found.system.is_geographic
    np.testing.assert_allclose(found.coordinates, [[151.25, -34.5, -12.5], [-13.4007, 52.51926, 99]], atol=1e-7)
    assert "2 photographs without a position" in found.notes[0]
    assert np.isnan(found.sigma).all() and found.usual_sigma == (5, 5, 10)


XMP = {
    "attributes": 'drone-dji:RtkStdLon="0.011" drone-dji:RtkStdLat="+0.012" drone-dji:RtkStdHgt="0.03"',
    "elements": "<Camera:GPSXYAccuracy>0.011</Camera:GPSXYAccuracy> <Camera:GPSZAccuracy>3/100</Camera:GPSZAccuracy>",
}


def test_accuracies_in_exif_and_xmp(tmp_path):
    """What is written counts; zeros, and what is no number, say nothing."""
    for name, given in {
        "error.jpg": ({"error": 4.5}, ""),
        "zero.jpg": ({"error": 0.0}, '<Camera:GPSXYAccuracy>0</Camera:GPSXYAccuracy> drone-dji:RtkStdLon="1e-e"'),
        "dji.jpg": ({"error": 4.5}, XMP["attributes"]),
        "pix4d.jpg": ({}, XMP["elements"]),
    }.items():
        body = b"http://ns.adobe.com/xap/1.0/\0" + given[1].encode()
        head = jpeg_with_position("<", 52.5, 13.4, 99, **given[0])[:-2]
        (tmp_path / name).write_bytes(head + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + b"\xff\xda")
    found = read_exif_positions(tmp_path, ["error.jpg", "zero.jpg", "dji.jpg", "pix4d.jpg"])
    expected = [[4.5, 4.5, 9.0], [np.nan] * 3, [0.011, 0.012, 0.03], [0.011, 0.011, 0.03]]
    np.testing.assert_allclose(found.sigma, expected)


def test_positions_in_tiff_files_whose_directories_follow_the_pixels(tmp_path):
    (tmp_path / "a.tif").write_bytes(tiff_with_position(">", 52.5, 13.4, 99, before=1 << 20))
    found = read_exif_positions(tmp_path, ["a.tif"])
    np.testing.assert_allclose(found.coordinates, [[13.4, 52.5, 99]], atol=1e-7)


def test_a_height_of_zero_by_zero_is_unknown(tmp_path):
    (tmp_path / "a.jpg").write_bytes(jpeg_with_position("<", 52.5, 13.4, np.nan))
    (tmp_path / "b.jpg").write_bytes(jpeg_with_position("<", 52.5, 13.4, 99))
    found = read_exif_positions(tmp_path, ["a.jpg", "b.jpg"])
    assert found.coordinates[:, 2].tolist() == [99, 99] and np.array_equal(found.sigma[:, 2], [1e4, np.nan], True)
    assert "1 photograph without a height" in found.notes[0]


def test_damaged_exif_is_no_position(tmp_path):
    good = jpeg_with_position("<", 52.5, 13.4, 99)
    rng = np.random.default_rng(0)
    for cut in range(0, len(good), 7):
        (tmp_path / "a.jpg").write_bytes(good[:cut])
        (tmp_path / "b.jpg").write_bytes(good)
        damaged = bytearray(good)
        damaged[rng.integers(20, len(good))] ^= int(rng.integers(1, 256))
        (tmp_path / "c.jpg").write_bytes(bytes(damaged))
        assert "b.jpg" in read_exif_positions(tmp_path, ["a.jpg", "b.jpg", "c.jpg"]).names
    with pytest.raises(InputError, match="None of the 1 photographs"):
        (tmp_path / "a.jpg").write_bytes(good[:30])
        read_exif_positions(tmp_path, ["a.jpg"])
