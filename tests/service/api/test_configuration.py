"""What `config` shows of a configuration with secrets in it."""

from __future__ import annotations

import json

import pytest

from coec.cli.check_config import example
from coec.config import ZenohConfig
from coec.service.configuration import redacted_configuration

KEY = "tls/vehicle:7448#connect_private_key_base64=c2VjcmV0;connect_certificate_file=/etc/c.pem"


@pytest.mark.fault("a key in an endpoint, when `config` is asked for", "it is hidden")
def test_keys_in_endpoints_are_hidden_and_the_rest_is_shown() -> None:
    config = example().model_copy(update={"zenoh": ZenohConfig(connect=(KEY,), listen=(KEY, "tcp/127.0.0.1:7447"))})
    document = redacted_configuration(config)
    assert "c2VjcmV0" not in json.dumps(document)
    assert document["zenoh"]["connect"] == [
        "tls/vehicle:7448#connect_private_key_base64=***;connect_certificate_file=/etc/c.pem"
    ]
    assert document["zenoh"]["listen"][1] == "tcp/127.0.0.1:7447"
    assert document["pairs"] == example().model_dump(mode="json")["pairs"]
