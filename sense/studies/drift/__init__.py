"""Denoising and drift compensation."""
