"""Names of `trilat_studies.tuning`, which files of users import from here."""

from trilat_studies.tuning import *  # noqa: F403
from trilat_studies.tuning import __all__ as __all__
