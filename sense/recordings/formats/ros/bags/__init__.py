"""Messages out of MCAP and SQLite files: whatever these claim, no more is unpacked or kept than is stated."""
