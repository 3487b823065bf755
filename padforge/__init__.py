"""From an idea to a calibrated soft strain-sensor pad.

`padforge.design`, `padforge.fabricate` and `padforge.sense` are the three stages. The names that most programs need are
also in this package: `padforge.search`, `padforge.build`, `padforge.Localizer`. All are loaded on first use.
"""

from pathlib import Path

import lazy_loader

# A checkout has the stages beside this package, a wheel has them inside it.
if not (Path(__file__).parent / "design").is_dir():
    __path__.append(str(Path(__file__).parents[1]))

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
