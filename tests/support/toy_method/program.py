"""Run with another method among the plugs; prints what the rest of the program makes of it, as JSON."""

import json
import sys
from pathlib import Path

from taichi_mrf.config.plugs import PLUGS

PLUGS.append("toy_method.plug")


def main(folder: Path) -> None:
    """Ask YAML, flags, map files and a live run's mapper; ``folder`` takes the files."""
    import small_room

    import taichi_mrf
    from taichi_mrf.cli.main import parse
    from taichi_mrf.config.schema import Config, load
    from taichi_mrf.config.sections import LogOddsConfig
    from taichi_mrf.config.text import commented_yaml
    from taichi_mrf.errors import TaichiMRFError
    from taichi_mrf.methods.registry import create_map, load_map
    from taichi_mrf.session.mapper import Mapper

    taichi_mrf.init("cpu")
    (folder / "config.yaml").write_text(
        commented_yaml(Config(method="toy", log_odds=LogOddsConfig(hit=0.8))), encoding="utf-8"
    )
    flags = ["map", "anything", "--out", "x", "--method", "toy", "--config", str(folder / "config.yaml")]
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
        "method": settings.method,
        "hit": settings.log_odds.hit,
        "refused": refused,
        "stale": stale,
        "settled": settled,
        "loaded": type(loaded).__name__,
        "loaded_hit": loaded.config.log_odds.hit,
        "keyframes": len(loaded.keyframes),
    }
    print(json.dumps(found))


main(Path(sys.argv[1]))
