"""Recordings from and to other programs: CSV, HDF5 and MATLAB files, of padforge's own form and of anyone's."""
