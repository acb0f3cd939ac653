"""Notebooks that are run as Jupyter runs them: the viewer that a cell returns opens."""

import nbformat
import pytest
from nbclient import NotebookClient
from scene_pages import WAIT, model

import igsr

SPLATS = """
import igsr
splats = igsr.Splats.load("scene.ply")
splats.show(height=300)
"""
REFINED = """
from igsr.refinement.results import Refined, Round
capture = igsr.Capture("photos", [])
done = Round([], [], splats, None)
Refined(splats, splats, None, capture, [done], None, [], {}).show(height=300)
"""


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("notebook")
    model().save(folder / "scene.ply")
    notebook = nbformat.v4.new_notebook()
    notebook.cells = [nbformat.v4.new_code_cell(cell) for cell in (SPLATS, REFINED)]
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(folder)}}).execute()
    return [cell.outputs[0]["data"]["text/html"] for cell in notebook.cells]


@pytest.mark.parametrize(("cell", "labels"), [(0, ["scene"]), (1, ["first fit", "round 1"])])
def test_a_notebook_cell_shows_the_viewer(browser, tmp_path, outputs, cell, labels):
    (tmp_path / "book.html").write_text(WAIT + outputs[cell], encoding="utf-8")
    browser.open(tmp_path / "book.html")
    assert browser.problems == []
    assert browser.run("frames[0].igsr.error") is None
    found = browser.run("frames[0].igsr.models.source.entries.map(({ label }) => label)")
    assert found == labels
    assert browser.run("frames[0].igsr.viewer.main.scene.count") == 400
    assert browser.run("frames[0].innerHeight") == 300
    with pytest.raises(igsr.IgsrError, match="height"):
        model().show(height=0)
