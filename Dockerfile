# Two stages: the first fetches what requirements.lock pins (every file checked against its hash) and builds the wheel,
# the second installs from those files alone, so that neither the build tools nor the checks end up in the image.
#
#   docker build -t coec .
#   docker run --network host -v ./deploy/coec.yaml:/etc/coec/coec.yaml:ro -v coec-state:/var/lib/coec coec
#
# With podman: `podman build --format docker`, because images in the OCI format have no health check.

# The digest is what is fetched (of the index: for every architecture), the tag tells people what it is: that of 19
# September 2026 by the image's own record, docker-library/repo-info 40cdaf34. `deploy/pin-images` renews both.
ARG PYTHON=python:3.11.16-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b

FROM ${PYTHON} AS build
WORKDIR /build
COPY requirements.lock requirements-release.lock ./
RUN pip download --quiet --require-hashes --requirement requirements.lock --dest packages
RUN python -m venv release && release/bin/pip install --quiet --require-hashes --requirement requirements-release.lock
RUN python -m venv tools && tools/bin/pip install --quiet --no-index --find-links packages hatchling
COPY pyproject.toml README.md LICENSE ./
COPY service service
# Compiled modules are checked by nobody against the times of their sources, so that the same packages give the same
# layer; their tests are left out. coec itself is moved to a folder of its own, for a layer of its own.
RUN tools/bin/hatchling build --target wheel --directory dist \
    && python -m venv /opt/coec \
    && /opt/coec/bin/pip install --quiet --no-compile --no-index --find-links packages dist/coec-*.whl \
    && /opt/coec/bin/python -m pip uninstall --quiet --yes setuptools pip \
    && find /opt/coec/lib -type d -name tests -prune -exec rm -rf {} + \
    && find /opt/coec/lib -type d -name __pycache__ -prune -exec rm -rf {} + \
    && /opt/coec/bin/python -m compileall -q --invalidation-mode unchecked-hash /opt/coec/lib
# What is in the image, under which licences: /opt/coec/sbom/coec.cdx.json (CycloneDX) and licences.md.
COPY deploy/bill-of-materials ./
RUN PATH="$PWD/release/bin:$PATH" ./bill-of-materials /opt/coec/bin/python /opt/coec/sbom
RUN packages="$(echo /opt/coec/lib/python3.*/site-packages)" && mkdir -p "/own$packages" /own/opt/coec/bin \
    && mv "$packages"/coec "$packages"/coec-*.dist-info "/own$packages" \
    && mv /opt/coec/bin/coec /own/opt/coec/bin && mv /opt/coec/sbom /own/opt/coec

FROM ${PYTHON}
RUN groupadd --gid 10001 coec \
    && useradd --uid 10001 --gid 10001 --no-create-home --home-dir /var/lib/coec --shell /usr/sbin/nologin coec \
    && install --directory --owner coec --group coec /var/lib/coec /var/cache/coec
# The packages, some 600 MB, which change with requirements.lock; then coec itself, some 15 MB.
COPY --from=build /opt/coec /opt/coec
COPY --from=build /own /
COPY deploy/check-live /opt/coec/bin/check-live
# Compiled kernels are cached below XDG_CACHE_HOME/coec: keep that folder on a volume for quick restarts. The heartbeat
# is what the health check looks at; it lies in memory, where also a read-only container can write.
ENV PATH=/opt/coec/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    XDG_CACHE_HOME=/var/cache \
    COEC_HEARTBEAT_FILE=/dev/shm/coec-heartbeat
# The number of the user `coec`: Kubernetes (runAsNonRoot) takes no name.
USER 10001:10001
# Compiles the kernels for every lens, so that a service whose processor is like that of the build has none to compile at
# its first start; on another processor it compiles those that it needs, once. A volume that is mounted on /var/cache
# for the first time is filled with them by Docker and podman, but not by Kubernetes.
RUN coec warmup
# Relative paths in the configuration are relative to its file: set `state: {directory: /var/lib/coec}`.
VOLUME ["/var/lib/coec", "/var/cache/coec"]
STOPSIGNAL SIGTERM
# Some milliseconds of the processor, without Python. A service is alive before its first start has compiled the
# kernels; the start period is for slow disks.
HEALTHCHECK --interval=30s --timeout=15s --start-period=180s --retries=4 CMD ["check-live"]
ENTRYPOINT ["coec"]
CMD ["run", "--config", "/etc/coec/coec.yaml"]
