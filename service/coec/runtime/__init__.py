"""The running service. A frame passes its packages in this order: ingest, recording, worker, decisions, api."""
