"""First live observations under shifts beside the golden buffer set, made up."""

from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

from support.buffer_sets import build, plan_again

from robomme_interference_data.build_dataset.dataset.frame_selection import select_demonstration
from robomme_interference_data.build_dataset.sources import Frame, Recording, SourceEpisode
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.constants import SHIFTED
from robomme_interference_data.schema.shifts import SHIFTS


class ShiftedSample(SampleSource):
    """Under the first shift the sample's queries look as always, under the n-th dimmed n times."""

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        recording = super().read(episode, cameras)
        return replace(recording, frames=self._views(recording))

    def _views(self, recording: Recording) -> Generator[Frame]:
        *_, seen = select_demonstration(recording.frames)
        for place in range(len(SHIFTS)):
            images = {camera: image >> place for camera, image in seen.images.items()}
            yield Frame(images, seen.state, None, False)


def add_shifted(buffer_set: Path, *families: str, kind: str = "sample") -> None:
    """Build views of the golden queries, or of some families, and plan the buffer set again."""
    source = ShiftedSample(size=32)
    source.provenance["kind"] = kind
    families = families or ("VideoRepick", "MoveCube", "PatternLock")
    build(buffer_set, SHIFTED, source, families=families, split="test")
    plan_again(buffer_set)
