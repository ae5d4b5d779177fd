"""Answers to the viewer's requests. An error in one becomes a notice for the user."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from taichi_mrf.session.edits import Edit, Pair
from taichi_mrf.session.extras import Extras
from taichi_mrf.session.files import MAP_FILE, MESH_FILE, VOXEL_FILE
from taichi_mrf.session.folder import write_mesh_file, write_report, write_voxel_file
from taichi_mrf.session.ray_answers import pixel_answer, point_answer
from taichi_mrf.session.run import Run
from taichi_mrf.viewer.messages import (
    File,
    Freeze,
    Listening,
    Move,
    Notice,
    Pause,
    PixelRay,
    Quit,
    RayThrough,
    Request,
    Reset,
    Save,
    Select,
    ShowTime,
    Speed,
    Step,
    Switch,
    Undo,
    Watch,
    WhoSays,
)

_FILES = {"map": MAP_FILE, "ply": VOXEL_FILE, "mesh": MESH_FILE}


def resumes_replay(request: Request) -> bool:
    """True if a request starts a paused replay again."""
    return isinstance(request, Step) or (isinstance(request, Pause) and not request.on)


class Requests:
    """Carries out the requests of the page."""

    def __init__(
        self,
        run: Run,
        extras: Extras,
        listening: Callable[[Listening], None],
        begin_anew: Callable[[Reset], None],
    ) -> None:
        self._run = run
        self._handlers: dict[type, Callable[[Any], None]] = {
            Listening: listening,
            Pause: self._pause,
            Step: self._step,
            Speed: self._speed,
            Reset: begin_anew,
            Switch: self._edit,
            Move: self._edit,
            Undo: self._undo,
            Freeze: self._freeze,
            RayThrough: self._ray_through,
            PixelRay: self._pixel_ray,
            WhoSays: lambda request: run.send(run.mapper.votes_at(request.points)),
            Select: run.select,
            Watch: extras.watch,
            ShowTime: lambda request: run.show_time(request.stamp_s, request.play),
            Save: self._save,
            Quit: self._quit,
        }

    def carry_out(self, request: Request) -> None:
        """Carry out a request; an error becomes a notice on the page."""
        self._run.guarded(lambda: self._handlers[type(request)](request))

    def _quit(self, request: Quit) -> None:
        self._run.ended = True

    def _pause(self, request: Pause) -> None:
        replay = self._run.replay
        if replay is None:
            return
        self._run.stepping = False
        if request.on:
            replay.pause()
        else:
            replay.resume()

    def _step(self, request: Step) -> None:
        replay = self._run.replay
        if replay is not None and not replay.finished:
            self._run.stepping = True

    def _speed(self, request: Speed) -> None:
        if self._run.replay is not None:
            self._run.replay.set_speed(request.factor)

    def _edit(self, request: Edit) -> None:
        mapper = self._run.mapper
        mapper.roster.find(request.keyframe)
        edits = [request]
        if isinstance(request, Switch) and request.last is not None:
            known = [each for each in mapper.roster.entries.values() if each.state != "frozen"]
            ids = [each.id for each in known if request.keyframe <= each.id <= request.last]
            edits = [Switch(id, request.on) for id in ids]
        made: list[Pair] = []
        try:
            self._carry_out(edits, made)
        finally:
            mapper.edits.note(made)

    def _undo(self, request: Undo) -> None:
        history = self._run.mapper.edits
        edits = history.next(request.again)
        if edits:
            self._carry_out(edits, [])
            history.step(request.again)

    def _carry_out(self, edits: list[Edit], made: list[Pair]) -> None:
        """Carry out edits; those that changed something are put into ``made``."""
        run = self._run
        try:
            for edit in edits:
                back, forth = run.mapper.edit(edit)
                if isinstance(back, Move) or back != forth:
                    made.append((back, forth))
        finally:  # even if one fails, the viewer is sent the present state
            for edit in edits:
                run.send(run.describe(edit.keyframe))
            run.show_time(None)
            run.publish()

    def _freeze(self, request: Freeze) -> None:
        self._run.send(self._run.mapper.freeze(request.keyframe))
        self._run.show_time(None)
        self._run.publish()

    def _ray_through(self, request: RayThrough) -> None:
        mapper, wanted = self._run.mapper, None
        if request.keyframe is not None:
            entry = mapper.roster.find(request.keyframe)
            wanted = mapper.posed_image(entry) if entry.state != "frozen" else None
        others = mapper.posed_images_near(np.asarray(request.point, np.float64))
        self._run.send(point_answer(mapper.map, request.point, request.eye, wanted, others))
        self._run.send(mapper.votes_at([request.point]))

    def _pixel_ray(self, request: PixelRay) -> None:
        mapper = self._run.mapper
        image = mapper.posed_image(mapper.roster.find(request.keyframe))
        self._run.send(pixel_answer(mapper.map, image, request.u, request.v))

    def _save(self, request: Save) -> None:
        """Send a file to the browser that asked for it; with --out it is also left in the run's folder, with
        the report and the parameters."""
        run, m, out = self._run, self._run.mapper.map, self._run.policy.out
        with tempfile.TemporaryDirectory() as temporary:
            path = (out or Path(temporary)) / _FILES[request.kind]
            if request.kind == "map":
                m.save(path)
            elif request.kind == "ply":
                write_voxel_file(path, m)
            else:
                run.send(Notice(f"{path.name} shows {write_mesh_file(path, m)}"))
            if out is not None:
                write_report(out, run.result(), run.facts)
            run.send(File(path.name, path.read_bytes(), request.client))
        if out is not None:
            run.send(Notice(f"{path.name} is in {out}"))
