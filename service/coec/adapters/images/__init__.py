"""Images: decoding, quality, and refusal of bad ones."""
