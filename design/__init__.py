"""Design soft strain-sensor pads: morphologies, the contact model, information, rules and search.

Names load on first use, so importing the package costs next to nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
