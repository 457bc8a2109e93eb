# erfsfm-slam on a CPU. Nothing builds this file in CI. From the root of the repository:
#   docker build --build-arg TORCH_INDEX=... --tag erfsfm-slam .
#   docker run --rm --user $(id -u) --volume $PWD:/data erfsfm-slam run --dataset drive.mp4 --output run
FROM python:3.11-slim AS build
ARG TORCH_INDEX=
ENV PATH=/opt/erfsfm/bin:$PATH PIP_NO_CACHE_DIR=1
WORKDIR /source
RUN python -m venv /opt/erfsfm
COPY requirements.lock constraints.txt ./
RUN pip install --require-hashes --no-deps --requirement requirements.lock \
    && pip install --constraint constraints.txt ${TORCH_INDEX:+--extra-index-url $TORCH_INDEX} torch
COPY pyproject.toml README.md LICENSE NOTICE ./
COPY configs configs
COPY erfsfm erfsfm
COPY slam slam
RUN pip install --no-deps --no-build-isolation .

FROM python:3.11-slim
# for Open3D
RUN apt-get update && apt-get install --yes --no-install-recommends libegl1 libgl1 libgomp1 libx11-6 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/erfsfm /opt/erfsfm
ENV PATH=/opt/erfsfm/bin:$PATH OMP_WAIT_POLICY=PASSIVE HOME=/tmp
WORKDIR /data
ENTRYPOINT ["erfsfm-slam"]
