"""Store credentials on their way to nodes: complete sets only, into no text."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import fsspec
import pytest

from coec.errors import SourceError
from coec.fleet.jobs import (
    GOOGLE,
    MAX_FILE_BYTES,
    Job,
    StoreCredentials,
    StoreError,
    fetched_window,
    redacted,
    stores_of,
)

SECRET = "wJalrXUtnFEMI/K7MDENG"
AWS = {"AWS_ACCESS_KEY_ID": "AKIDEXAMPLE", "AWS_SECRET_ACCESS_KEY": SECRET, "AWS_REGION": "eu-central-1"}


def test_only_the_stores_of_the_windows_get_their_credentials() -> None:
    assert stores_of([Job("s3://a/1.mcap"), Job("/data/2.mcap"), Job("memory://3.mcap")]) == {"s3"}
    environment = AWS | {"AZURE_STORAGE_ACCOUNT_KEY": "azure-key", "PATH": "/bin"}
    assert set(StoreCredentials.from_environment({"s3"}, environment).names) == set(AWS)
    assert set(StoreCredentials.from_environment({"az"}, environment).names) == {"AZURE_STORAGE_ACCOUNT_KEY"}
    assert not StoreCredentials.from_environment((), environment).names


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"AWS_REGION": "eu-central-1", "AWS_ENDPOINT_URL": "http://store"},
        {"AWS_ACCESS_KEY_ID": "AKIDEXAMPLE", "AWS_SECRET_ACCESS_KEY": ""},
        {"AWS_PROFILE": "fleet", "AWS_WEB_IDENTITY_TOKEN_FILE": "/var/token", "AWS_ROLE_ARN": "arn"},
    ],
)
def test_without_a_complete_key_nothing_is_sent_and_nodes_use_their_own(environment: dict[str, str]) -> None:
    credentials = StoreCredentials.from_environment({"s3", "gs", "az"}, environment)
    assert credentials.values == {}
    assert credentials.google is None


def test_what_does_not_belong_to_the_key_is_removed_on_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """A session token of the node would make the caller's key invalid."""
    for name in (*AWS, "AWS_SESSION_TOKEN"):
        monkeypatch.setenv(name, "of the node")
    pickle.loads(pickle.dumps(StoreCredentials.from_environment({"s3"}, AWS))).install()
    assert {name: os.environ.get(name) for name in AWS} == AWS
    assert "AWS_SESSION_TOKEN" not in os.environ


def test_of_googles_file_the_content_is_sent_and_stays_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "key.json"
    path.write_text('{"type": "service_account"}')
    credentials = StoreCredentials.from_environment({"gs"}, {GOOGLE: str(path)})
    path.unlink()
    monkeypatch.setenv(GOOGLE, "")
    credentials.install()
    assert os.environ[GOOGLE] != str(path)
    for _ in range(2):
        assert Path(os.environ[GOOGLE]).read_text() == '{"type": "service_account"}'
    with pytest.raises(SourceError, match=GOOGLE):
        StoreCredentials.from_environment({"gs"}, {GOOGLE: str(path)})
    path.write_bytes(b"x" * (MAX_FILE_BYTES + 1))
    with pytest.raises(SourceError, match="no file of credentials"):
        StoreCredentials.from_environment({"gs"}, {GOOGLE: str(path)})


@pytest.mark.fault("a store's library quotes a secret in its error", "the row has the name of the variable instead")
def test_no_secret_gets_into_a_text(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in AWS.items():
        monkeypatch.setenv(name, value)
    assert SECRET not in repr(StoreCredentials.from_environment({"s3"}, AWS))
    assert redacted(f"bad signature by {SECRET}") == "bad signature by [AWS_SECRET_ACCESS_KEY]"

    def fail(*_: object) -> None:
        raise PermissionError(f"refused: {SECRET}")

    monkeypatch.setattr(fsspec.core, "url_to_fs", fail)
    with pytest.raises(StoreError) as raised, fetched_window("s3://a/1.mcap"):
        pass
    assert SECRET not in str(raised.value)
    assert "AWS_SECRET_ACCESS_KEY" in str(raised.value)
