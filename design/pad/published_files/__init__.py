"""Files as the published study left them, and the containers they come in: MATLAB's, and HDF5."""
