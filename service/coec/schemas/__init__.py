"""The wire contract: what goes over Zenoh and into files, as pydantic models. Nothing heavier is imported
here."""
