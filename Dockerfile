# Plays avatars; as any user, on a read-only file system with a /tmp:
#   docker build -t rnd-avatar .
#   docker run --rm --read-only --tmpfs /tmp -v "$PWD:/data" --user "$(id -u)" rnd-avatar avatar.onnx --motion walk.npz --out out
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY runtime runtime
COPY viewer viewer
COPY trainer trainer
COPY export export
RUN pip install --no-cache-dir --prefix /install ".[video,view]"

FROM python:3.11-slim
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /install /usr/local
RUN useradd --no-create-home rnd
USER rnd
WORKDIR /data
ENTRYPOINT ["rnd-play"]
