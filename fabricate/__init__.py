"""Turn a morphology into the printable inverse mould of its pad, checked and drawn.

Names load on first use, so importing the package costs next to nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
