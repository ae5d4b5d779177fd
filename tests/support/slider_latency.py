"""How long the live page takes to answer a slider while the map is being inferred, measured in the browser.

    python tests/support/slider_latency.py

maps the built-in room with voxels of 2 cm, and prints the median of 20 answers.
"""

import statistics
from dataclasses import dataclass

from browser import LivePage, chromium, live_page

# One step of the threshold to the right, then one to the left; the clock runs in the page, from the key on
# the slider's thumb until the sentence with the number of voxels is another one.
_MEASURE = """async ([slider, step]) => {
  const thumb = document.getElementById(slider).querySelector('[role=slider]');
  const sentence = () => [...document.querySelectorAll('p')].map(p => p.textContent)
    .find(text => text.includes('voxels shown'));
  const before = sentence();
  const begin = performance.now();
  const answer = new Promise(resolve => {
    const observer = new MutationObserver(() => {
      if (sentence() === before) return;
      observer.disconnect();
      resolve((performance.now() - begin) / 1000);
    });
    observer.observe(document.body, {subtree: true, childList: true, characterData: true});
  });
  thumb.dispatchEvent(new KeyboardEvent('keydown', {key: step, bubbles: true}));
  return await answer;
}"""

PAUSE_S = 1.0
"""Between an answer and the next question, so that the page has drawn what it got."""


@dataclass(frozen=True)
class Answer:
    """One answer: how long it took, and what the worker was doing before and after."""

    seconds: float
    before: str
    after: str

    @property
    def while_inferring(self) -> bool:
        """True if the map was being inferred all the time."""
        return self.before.startswith("sweeping") and self.after.startswith("sweeping")


def slider_answers(page: LivePage, count: int) -> list[Answer]:
    """Move the threshold ``count`` times; the tab with it must be in front."""
    slider = page.input("Threshold").get_attribute("id")
    answers = []
    for i in range(count):
        before = page.look().activity
        seconds = page.page.evaluate(_MEASURE, [slider, ("ArrowRight", "ArrowLeft")[i % 2]])
        answers.append(Answer(seconds, before, page.look().activity))
        page.pause(PAUSE_S)
    return answers


def main() -> None:
    """Measure, and print what was found."""
    with chromium() as browser, live_page(browser, "synthetic:room", "--voxel-size", "0.02") as page:
        page.until(lambda seen: seen.activity.startswith("sweeping") and seen.agrees, "inference")
        voxels = page.look().voxels
        answers = [each for each in slider_answers(page, 20) if each.while_inferring]
    seconds = [each.seconds for each in answers]
    print(
        f"{len(seconds)} answers while inferring a map of {voxels:,} voxels: median "
        f"{statistics.median(seconds):.3f} s, fastest {min(seconds):.3f} s, slowest {max(seconds):.3f} s"
    )


if __name__ == "__main__":
    main()
