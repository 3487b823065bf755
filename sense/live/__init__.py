"""Localization of touches in real time, and its outputs."""
