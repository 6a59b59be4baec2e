"""The hooks of this package, which ventosa finds through the entry point in pyproject.toml."""

from trainers.hookspecs import hookimpl
from ventosa_sac.sac import SAC


@hookimpl
def ventosa_trainers() -> dict[str, type]:
    """Offer the algorithm under the name that a run file's `trainer_type` has."""
    return {"sac": SAC}
