# Two stages: the first fetches what requirements.lock pins (every file checked against its hash) and builds the wheel,
# the second installs from those files alone, so that neither the build tools nor the checks end up in the image.
#
#   docker build -t coec .
#   docker run --network host -v ./deploy/coec.yaml:/etc/coec/coec.yaml:ro -v coec-state:/var/lib/coec coec

# The digest is what is fetched (of the index: for every architecture), the tag tells people what it is: that of 19
# September 2026 by the image's own record, docker-library/repo-info 40cdaf34. `deploy/pin-images` renews both.
ARG PYTHON=python:3.11.16-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b

FROM ${PYTHON} AS build
WORKDIR /build
COPY requirements.lock ./
RUN pip download --quiet --require-hashes --requirement requirements.lock --dest packages
RUN python -m venv tools && tools/bin/pip install --quiet --no-index --find-links packages hatchling
COPY pyproject.toml README.md LICENSE ./
COPY service service
RUN tools/bin/hatchling build --target wheel --directory dist \
    && python -m venv /opt/coec \
    && /opt/coec/bin/pip install --quiet --no-index --find-links packages dist/coec-*.whl \
    && /opt/coec/bin/python -m pip uninstall --quiet --yes setuptools pip \
    && /opt/coec/bin/python -m compileall -q /opt/coec/lib
# What is in the image, under which licences: /opt/coec/sbom/coec.cdx.json (CycloneDX) and licences.md.
RUN /opt/coec/bin/coec sbom --lock requirements.lock --output /opt/coec/sbom

FROM ${PYTHON}
RUN useradd --uid 10001 --no-create-home --home-dir /var/lib/coec --shell /usr/sbin/nologin coec \
    && install --directory --owner coec --group coec /var/lib/coec /var/cache/coec
COPY --from=build /opt/coec /opt/coec
# Compiled kernels are cached below XDG_CACHE_HOME/coec: keep that folder on a volume for quick restarts.
ENV PATH=/opt/coec/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    XDG_CACHE_HOME=/var/cache
USER coec
# Compiles the kernels for every lens, so that a service whose processor is like that of the build has none to compile at
# its first start; on another processor it compiles those that it needs, once. A volume that is mounted on /var/cache
# for the first time is filled with them by Docker and podman, but not by Kubernetes.
RUN coec warmup
# Relative paths in the configuration are relative to its file: set `state: {directory: /var/lib/coec}`.
VOLUME ["/var/lib/coec", "/var/cache/coec"]
STOPSIGNAL SIGTERM
# The first start compiles the kernels.
HEALTHCHECK --interval=30s --timeout=10s --start-period=120s --retries=3 \
    CMD ["coec", "query", "status", "--config", "/etc/coec/coec.yaml"]
ENTRYPOINT ["coec"]
CMD ["run", "--config", "/etc/coec/coec.yaml"]
