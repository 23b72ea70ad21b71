"""The phases of the fit, and how much work each of them is."""

from collections.abc import Iterable
from dataclasses import dataclass

from slomo.reconstruct.problem import Schedule

PHASES = ("heading", "gait", "rivals", "final", "limbs", "alike", "overtaking", "the other pair")
LIMBS = PHASES.index("limbs")  # the last phase that all clips have
FINAL = PHASES.index("final")  # from there on little is between two hypotheses, and many draws tell them apart
_RARE = {"alike": 0.5, "overtaking": 0.2, "the other pair": 0.1}  # share of clips that have these phases, about


@dataclass(frozen=True)
class Effort:
    """How much work each phase does (`FitConfig` says it in the user's terms)."""

    schedules: tuple[Schedule, ...]
    candidates: int
    phases_of_gait: int

    def reached(self, over: Iterable[str], phase: str, share: float = 0.0) -> float:
        """Of all the work, in [0, 1], what is done once `share` of a phase is. It leaps where phases are skipped, and
        never goes back.

        Args:
            over: the phases that are over.
        """
        work = {
            name: s.iterations * (s.frames * s.pixels + 2000) for name, s in zip(PHASES, self.schedules, strict=True)
        }
        done = 0.0
        for name in (*(p for p in PHASES if p in over), phase):
            later = PHASES[PHASES.index(name) + 1 :]
            left = work[name] + sum(_RARE.get(p, 1.0) * work[p] for p in later)
            if left:
                done += (1 - done) * work[name] / left * (share if name == phase else 1.0)
        return done
