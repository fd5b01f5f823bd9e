"""Scenes that several files trace, opened once; who changes one restores it. Imports wait until they are used."""

import pytest


@pytest.fixture(scope="session")
def shoebox_xml(tmp_path_factory):
    from traced_rooms import SHOEBOX, write_xml

    return write_xml(tmp_path_factory.mktemp("shoebox"), SHOEBOX)


@pytest.fixture(scope="session")
def divided_xml(tmp_path_factory):
    """The shoebox with a partition that leaves gaps."""
    from traced_rooms import PARTITION, SHOEBOX, write_xml

    return write_xml(tmp_path_factory.mktemp("divided"), {**SHOEBOX, **PARTITION})


@pytest.fixture(scope="session")
def box_xml(tmp_path_factory):
    from box_room import CEILING, PARTITION, WALLS
    from traced_rooms import write_xml

    return write_xml(tmp_path_factory.mktemp("box"), {**WALLS, **CEILING, **PARTITION})


def opened(xml, room):
    from wrf_mi.tracing import open_scene

    return open_scene(xml, room.FREQUENCY_HZ, room.THICKNESS_M)


@pytest.fixture(scope="session")
def shoebox(shoebox_xml):
    import traced_rooms

    return opened(shoebox_xml, traced_rooms)


@pytest.fixture(scope="session")
def divided(divided_xml):
    import traced_rooms

    return opened(divided_xml, traced_rooms)


@pytest.fixture(scope="session")
def box(box_xml):
    import box_room

    return opened(box_xml, box_room)


@pytest.fixture(scope="session")
def empty():
    """No surfaces, at `traced_rooms.FREQUENCY_HZ`."""
    from sionna import rt
    from traced_rooms import FREQUENCY_HZ

    scene = rt.load_scene()
    scene.frequency = FREQUENCY_HZ
    return scene
