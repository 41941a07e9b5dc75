# One image for the service and its workers; docker-compose.yml selects the command.
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY pins pins
COPY heliopsf heliopsf
COPY psfcore psfcore
COPY service service
COPY workers workers
RUN python -m venv /opt/heliopsf \
 && /opt/heliopsf/bin/pip install --no-cache-dir --require-hashes -r pins/service.txt \
 && /opt/heliopsf/bin/pip install --no-cache-dir --no-deps --no-build-isolation .

FROM python:3.11-slim
COPY --from=build /opt/heliopsf /opt/heliopsf
# The oldest processor on which the compiled kernels of this image run; see docs/operating.md.
ARG KERNELS_CPU=x86-64-v3
ENV PATH=/opt/heliopsf/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CPU_NAME=$KERNELS_CPU \
    NUMBA_CPU_FEATURES= \
    NUMBA_CACHE_DIR=/opt/heliopsf/kernels
RUN heliopsf doctor --compile \
 && useradd --create-home --uid 10001 heliopsf \
 && install -d -o heliopsf -g heliopsf /data
USER heliopsf
# Libraries write their caches below HOME; /tmp is the only such folder that a read-only container has.
ENV HOME=/tmp \
    HELIOPSF_DATA_DIR=/data
VOLUME /data
EXPOSE 8765
CMD ["heliopsf", "serve", "--host", "0.0.0.0"]
