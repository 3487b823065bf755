from .hands import hands

__all__ = ["hands"]
