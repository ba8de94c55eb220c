"""The modulus that recordings were compared with, and the modulus that they measure."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from palpd.analysis.modulus_intervals import NORMAL_95
from palpd.cell.effects.tissue import MODULUS
from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisances import stable_inverse
from palpd.gap.model.linearise import Linearisation
from palpd.gap.model.problem import SHARED, Problem
from palpd.quantities import quantity


@dataclass(frozen=True)
class ComparedModulus:
    """The modulus of a cell file, and the modulus that its recordings show.

    Attributes:
        compared_Pa: As the cell file states it, times the ratio of a known effect `tissue.modulus` in that file.
        site: The site for which the file states it; None where it does so for no site.
        measured_Pa: The modulus of the same cell that fits the recordings best, all else within its tolerances.
        ci95_Pa: Its 95 % interval.
        far: Whether the two differ by more than the file's tolerance and the interval allow.
    """

    compared_Pa: float
    site: str | None
    measured_Pa: float
    ci95_Pa: tuple[float, float]
    far: bool

    @property
    def sentence(self) -> str:
        """Both moduli and their distance in words."""
        of_site = f" of site {self.site}" if self.site is not None else ""
        measured = quantity(self.measured_Pa, "Pa", self.ci95_Pa)
        doubt = " Is it this sample's? tolerances.youngs_modulus: 1.0 says that it is not known." if self.far else ""
        return (
            f"The cell file's modulus{of_site} is {quantity(self.compared_Pa, 'Pa')}; the recording measures {measured}, "
            f"{self.measured_Pa / self.compared_Pa - 1.0:+.1%}.{doubt}"
        )

    def to_json(self) -> dict[str, Any]:
        """The content of `modulus` in out.json."""
        return asdict(self) | {"ci95_Pa": list(self.ci95_Pa), "sentence": self.sentence}


def compared_modulus(problem: Problem, stated: Linearisation, site: str | None) -> ComparedModulus | None:
    """Measure the modulus of a cell whose file states it, without the tolerance that the file gives it.

    The force is proportional to the modulus, so one linear step finds it.

    Args:
        stated: Linearisation of the cell as stated, η₀ = 0, without effects.
        site: The site for which the file states the modulus; None where it does so for no site.

    Returns:
        Both moduli; None where the file states no modulus, or the recordings hold no contact.
    """
    number, columns, tissue = SHARED.index("youngs_modulus"), stated.space.columns, problem.cell.tissue
    if tissue is None or not problem.cell.tolerances.modulus_known or not columns.gram[number, number] > 0.0:
        return None
    prior = np.ones(columns.size)
    prior[number] = 0.0
    covariance = stable_inverse(np.diag(prior) + columns.gram)
    residual = problem.data - stated.prediction + stated.offset()
    deviation = float(covariance[number] @ columns.against(dict(enumerate(residual))))
    tolerance = float(problem.shared_sd[number])
    sigma = tolerance * float(np.sqrt(max(covariance[number, number], 0.0)))
    ratio = problem.cell.effects.get(MODULUS.id, {}).get("ratio", 1.0)
    compared_Pa = tissue.youngs_modulus_Pa * ratio
    measured_Pa = compared_Pa * (1.0 + tolerance * deviation)
    half_Pa = NORMAL_95 * sigma * compared_Pa
    far = abs(tolerance * deviation) > ASSUMED.naming.modulus_apart_sd * float(np.hypot(tolerance, sigma))
    return ComparedModulus(compared_Pa, site, measured_Pa, (measured_Pa - half_Pa, measured_Pa + half_Pa), far)
