"""Run with another method among the plugs; prints what the rest of the program makes of it, as JSON."""

import json
import sys
from pathlib import Path

from taichi_mrf.config.plugs import PLUGS

PLUGS.append("toy_method.plug")


def main(folder: Path) -> None:
    """Ask YAML, flags, sliders, map files and a live run's mapper; ``folder`` takes the files."""
    import small_room

    import taichi_mrf
    from taichi_mrf.cli.main import parse
    from taichi_mrf.config.schema import Config, load
    from taichi_mrf.config.text import commented_yaml
    from taichi_mrf.errors import TaichiMRFError
    from taichi_mrf.live.mapper import Mapper
    from taichi_mrf.methods.registry import create_map, load_map
    from taichi_mrf.viewer.tune.knobs import KNOBS

    taichi_mrf.init("cpu")
    (folder / "config.yaml").write_text(commented_yaml(Config(method="toy")), encoding="utf-8")
    flags = ["map", "anything", "--out", "x", "--method", "toy", "--toy.boldness", "0.8"]
    _, options = parse(flags)
    settings = options.settings
    frames = small_room.frames()[:2]
    m = create_map(settings, frames[0].camera)
    first, _ = [small_room.add(m, frame) for frame in frames]
    mapper = Mapper(m)
    try:
        mapper.freeze(first)
        refused = ""
    except TaichiMRFError as error:
        refused = str(error)
    mapper.switch(first, on=False)
    stale = mapper.stale
    with mapper.settling() as settling:
        settled = settling.run() is not None
    m.save(folder / "map.npz")
    loaded = load_map(folder / "map.npz")
    found = {
        "yaml": load(folder / "config.yaml").method,
        "yaml_keys": list(vars(Config())),
        "method": settings.method,
        "boldness": settings.toy.boldness,
        "sliders": [knob.name for knob in KNOBS if knob.applies(settings) and knob.method],
        "refused": refused,
        "stale": stale,
        "settled": settled,
        "loaded": type(loaded).__name__,
        "loaded_boldness": loaded.config.toy.boldness,
        "keyframes": len(loaded.keyframes),
    }
    print(json.dumps(found))


main(Path(sys.argv[1]))
