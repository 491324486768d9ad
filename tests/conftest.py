"""What holds for every test: bakes are kept in a folder of its own, and none are found that the user keeps."""

import uuid

import pytest


@pytest.fixture(autouse=True)
def own_folder_of_bakes(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("WARP_GI_BAKES", str(tmp_path_factory.getbasetemp() / f"bakes {uuid.uuid4()}"))
