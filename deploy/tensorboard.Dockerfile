# TensorBoard for the runs in a volume: the profile `tensorboard` of compose.yaml. It contains none of our programs.
#
#     docker build --file deploy/tensorboard.Dockerfile --tag comic-tensorboard:0.1.0 .
ARG DEBIAN_IMAGE=debian:bookworm-slim

FROM ${DEBIAN_IMAGE} AS wheels
ARG DEBIAN_MIRROR=http://deb.debian.org
ARG PIP_INDEX_URL=
COPY deploy/ca-certificates /usr/local/share/ca-certificates
RUN find /etc/apt -name '*.sources' -o -name sources.list | xargs sed --in-place "s|http://deb.debian.org|$DEBIAN_MIRROR|" \
    && apt-get update \
    && apt-get install --yes --no-install-recommends ca-certificates python3-pip \
    && update-ca-certificates
COPY deploy/tensorboard-requirements.txt /tmp/
RUN pip install --no-cache-dir --cert /etc/ssl/certs/ca-certificates.crt --target /opt/tensorboard --only-binary :all: \
        --no-deps --require-hashes --requirement /tmp/tensorboard-requirements.txt

FROM ${DEBIAN_IMAGE} AS tensorboard
ARG DEBIAN_MIRROR=http://deb.debian.org
RUN find /etc/apt -name '*.sources' -o -name sources.list | xargs sed --in-place "s|http://deb.debian.org|$DEBIAN_MIRROR|" \
    && apt-get update \
    && apt-get install --yes --no-install-recommends python3 \
    && apt-get clean \
    && rm -r /var/lib/apt/lists/* \
    && groupadd --gid 10001 comic \
    && useradd --uid 10001 --gid comic --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin comic \
    && install --directory --owner comic --group comic /runs
COPY --from=wheels /opt/tensorboard /opt/tensorboard
# TensorBoard connects to its own reader process by gRPC, and must not use a proxy for that.
ENV PYTHONPATH=/opt/tensorboard PYTHONDONTWRITEBYTECODE=1 no_grpc_proxy=localhost
USER 10001:10001
EXPOSE 6006
HEALTHCHECK --interval=30s --timeout=10s --start-period=60s CMD ["python3", "-c", \
    "import http.client; c = http.client.HTTPConnection('127.0.0.1', 6006, timeout=5); c.request('GET', '/'); exit(c.getresponse().status != 200)"]
ENTRYPOINT ["python3", "-m", "tensorboard.main", "--logdir", "/runs", "--host", "0.0.0.0", "--port", "6006"]
