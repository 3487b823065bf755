"""Whether a mould prints, demoulds and lets the fibres be laid, as far as its plan tells."""

from .inspection import check, check_plan, inspect, inspect_file, meshed

__all__ = ["check", "check_plan", "inspect", "inspect_file", "meshed"]
