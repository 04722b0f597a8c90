"""The running service, in the order of a frame's way: ingest, recording, worker, decisions, api."""
