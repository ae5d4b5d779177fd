"""Updates that the live page gets once it is shown: the measured surface, and readings of the map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_scene import CONFIG, FakeLink, finished, map_voxels, never, session_of, shown

from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.evaluation.pictures.room_views import smooth_borders
from taichi_mrf.export.formats import export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.session import extras
from taichi_mrf.viewer.messages import (
    File,
    Freeze,
    Notice,
    Request,
    Save,
    ShowTime,
    Status,
    SurfacePatch,
    SurfaceView,
    Switch,
    Update,
    Watch,
)

pytestmark = pytest.mark.usefixtures("one_backend")

SHOW = Watch(images=False, view=None, baseline=False, surface=True)

Triangle = tuple[tuple[float, ...], ...]


def of_page(link: FakeLink) -> set[Triangle]:
    """The triangles that the page has, each by its corners."""
    return as_set(np.concatenate([patch.vertices_m[patch.triangles] for patch in latest_patches(link)]))


def latest_patches(link: FakeLink) -> list[SurfacePatch]:
    """The patches that the page has in the end."""
    return list({patch.chunk: patch for patch in link.of_type(SurfacePatch)}.values())


def of_map(m: MRFMap) -> set[Triangle]:
    surface = m.surface()
    vertices_m = smooth_borders(surface.vertices_m, surface.triangles)
    return as_set(vertices_m[surface.triangles].astype(np.float32))


def as_set(corners: np.ndarray) -> set[Triangle]:
    return {tuple(map(tuple, triangle)) for triangle in corners.tolist()}


def test_the_page_gets_the_surface_of_the_map_when_it_shows_it() -> None:
    link = FakeLink()
    session = session_of(link)
    finished(session)
    assert not link.of_type(SurfacePatch)
    link.ask(SHOW)
    m = finished(session)
    assert of_page(link) == of_map(m)
    whole = len(link.of_type(SurfacePatch))
    finished(session)
    assert len(link.of_type(SurfacePatch)) == whole  # nothing has changed
    link.ask(Switch(1, on=False))
    m = finished(session)
    assert of_page(link) == of_map(m)
    view, picture = link.of_type(SurfaceView)[-1], m.surface()
    middle = np.median(picture.vertices_m, axis=0)
    assert view.up @ [0, 0, 1] > 0.99  # the room's
    assert (view.eye_m - middle) @ view.up > 0.5 * np.linalg.norm(view.eye_m - middle) > 1.0
    surfaced = [each for each in link.sent if isinstance(each, SurfacePatch | SurfaceView)]
    assert isinstance(surfaced[-1], SurfaceView)
    link.ask(Freeze(0))
    finished(session)
    assert not any(len(patch.triangles) for patch in latest_patches(link))  # it would lack a part
    why = link.of_type(Status)[-1].no_surface
    assert link.of_type(Notice)[-1].text == f"no surface: {why}"
    assert why.startswith("the images of 1 frozen keyframes are no")
    assert link.errors() == []


def test_the_surface_waits_for_full_inference() -> None:
    link = FakeLink()
    link.ask(SHOW)
    finished(session_of(link))
    done = [each.activity.partition(" keyframe")[0] for each in link.of_type(Status)]
    assert done.count("sweeping") > 0
    first = next(i for i, each in enumerate(link.sent) if isinstance(each, SurfacePatch))
    after = [each.activity for each in link.sent[first:] if isinstance(each, Status)]
    assert not any(activity.startswith("sweeping") for activity in after)


def test_an_edit_ends_the_making_of_a_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "ASK_SECONDS", 0.0)
    edits: list[Request] = [Switch(2, on=False)]

    def at_the_surface(update: Update) -> list[Request]:
        making = isinstance(update, Status) and update.activity == "making the surface"
        return [edits.pop()] if making and edits else []

    link = FakeLink(at_the_surface)
    link.ask(SHOW)
    m = finished(session_of(link))
    assert not edits
    assert len(m.keyframes) == 3
    assert of_page(link) == of_map(m)


def test_a_map_without_a_surface_says_why() -> None:
    link = FakeLink()
    session = session_of(link, config=replace(CONFIG, method="log_odds"))
    link.ask(SHOW)
    session.run(never)
    assert link.of_type(Notice)[-1].text == "no surface: a map of the method log_odds has none"
    assert not link.of_type(SurfacePatch)


def test_voxels_are_those_that_are_occupied() -> None:
    link = FakeLink()
    session = session_of(link)
    m = finished(session)
    by_rays = shown(link.sent).voxels()
    assert by_rays == map_voxels(m) > map_voxels(m.layer())
    link.ask(Switch(1, on=False))
    m = finished(session)
    assert by_rays != shown(link.sent).voxels() == map_voxels(m)
    session.reconnect(other := FakeLink())
    finished(session)
    assert shown(other.sent).voxels() == map_voxels(m)
    assert link.errors() == []


def test_the_past_is_that_of_marginals() -> None:
    link = FakeLink()
    session = session_of(link, config=replace(CONFIG, time=TimeConfig(half_life_s=600.0)))
    m = finished(session)
    now, then = map_voxels(m), m.keyframes[0].stamp_s
    assert shown(link.sent).voxels() == now
    link.ask(ShowTime(then))
    finished(session)
    assert shown(link.sent).voxels() == map_voxels(m.at(then))
    link.ask(ShowTime(None))
    finished(session)
    assert shown(link.sent).voxels() == now


def test_the_button_saves_the_mesh_that_export_writes(tmp_path: Path) -> None:
    link = FakeLink()
    session = session_of(link)
    m = finished(session)
    link.ask(Save("mesh", 7))
    finished(session)
    (file,) = link.of_type(File)
    export_map(m, tmp_path / "mesh.ply", ExportOptions(mesh=True))
    assert file.name == "mesh.ply"
    assert file.content == (tmp_path / "mesh.ply").read_bytes()
    assert link.of_type(Notice)[-1].text == "mesh.ply shows the surface that the rays of 4 keyframes measured"
