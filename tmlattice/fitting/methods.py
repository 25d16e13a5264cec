"""`fine_tune`: one call, four methods."""

from enum import StrEnum
from typing import Any

from tmlattice.by_name import by_name
from tmlattice.errors import unknown_choice
from tmlattice.fitting.adam import FitResult, fit_adam
from tmlattice.fitting.few import fit_sparse
from tmlattice.fitting.many import fit_map
from tmlattice.measurement import Measurement
from tmlattice.network import SymplecticNetwork, TaylorNetwork


class Method(StrEnum):
    """How a network is fine-tuned."""

    ADAM = "adam"
    MAP = "map"
    SPARSE = "sparse"
    TOLD = "told"


@by_name
def fine_tune(
    network: TaylorNetwork | SymplecticNetwork,
    measurement: Measurement,
    *,
    method: Method | str = "adam",
    **options: Any,
) -> FitResult:
    """Fit a network to the first turn of a measurement; the given network is left as it is.

    Args:
        network: the design.
        measurement: launches and readings.
        method: "adam", every weight free and a symplectic penalty, the paper's recipe
            (`fitting.adam.fit_adam`); "map", the most probable changes under a prior
            (`fitting.many.fit_map`); "sparse", as few changed magnets as the evidence asks for
            (`fitting.few.fit_sparse`); "told", the same that knows which magnets may have changed
            (`candidates=`): nothing else can be better. All but the first state the error of their
            tunes.
        options: of the method, see there.

    Raises:
        ChoiceError: an unknown method; it is a ValueError too.
        ValueError: an option's value.
        TmlatticeError: a measurement that cannot be fitted, see the methods.
    """
    try:
        chosen = Method(method)
    except ValueError:
        raise unknown_choice("method", method, Method) from None
    if chosen is Method.ADAM:
        return fit_adam(network, measurement, **options)
    if chosen is Method.MAP:
        return fit_map(network, measurement, **options)
    if chosen is Method.TOLD and not options.get("candidates"):
        raise ValueError(
            "method 'told' is told the magnets that may have changed: give candidates="
        )
    if isinstance(network, SymplecticNetwork):
        if network.ring is None:
            raise ValueError("methods 'sparse' and 'told' need a network made from a ring")
        network = TaylorNetwork.from_ring(network.ring, network.dimension)
    return fit_sparse(network, measurement, **options)
