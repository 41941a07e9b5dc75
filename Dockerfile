# One image for the service and its workers; docker-compose.yml says which is which.
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY heliopsf heliopsf
COPY psfcore psfcore
COPY service service
COPY workers workers
RUN python -m venv /opt/heliopsf \
 && /opt/heliopsf/bin/pip install --no-cache-dir -c constraints.txt '.[s3]'

FROM python:3.11-slim
COPY --from=build /opt/heliopsf /opt/heliopsf
RUN useradd --create-home --uid 10001 heliopsf \
 && install -d -o heliopsf -g heliopsf /data
USER heliopsf
ENV PATH=/opt/heliopsf/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/tmp/numba \
    HELIOPSF_DATA_DIR=/data
VOLUME /data
EXPOSE 8765
CMD ["heliopsf", "serve", "--host", "0.0.0.0"]
