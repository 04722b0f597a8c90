"""Images: decoded, measured, refused."""
