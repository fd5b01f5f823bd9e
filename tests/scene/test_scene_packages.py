"""What is said where a package of the extra ``lidar`` cannot be used."""

from __future__ import annotations

import pytest

from wrf_mi.core import InputError
from wrf_mi.scene import packages


def test_missing_package_and_missing_library_have_their_own_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"need no_such_package: pip install 'wrf-mi\[lidar\]'"):
        packages.lidar_package("no_such_package")

    def unlinked(name: str) -> None:
        raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(packages, "import_module", unlinked)
    with pytest.raises(InputError, match=r"open3d cannot be loaded \(libusb.*apt-get install libusb-1.0-0") as caught:
        packages.lidar_package("open3d")
    assert "\n" not in str(caught.value)
