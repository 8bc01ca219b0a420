# flowsplat on a CPU (not tested: no image has been built of this yet).
#   docker build -t flowsplat --build-arg TORCH_INDEX=ADDRESS .
#   docker run --rm -v "$PWD:/data" flowsplat run clip.mp4 -o out/clip
#   docker run --rm -v "$PWD:/data" -p 8080:8080 flowsplat view out/clip --host 0.0.0.0
FROM python:3.11-slim
# Where torch without CUDA comes from: the index for "CPU" that pytorch.org names under "Get started". Without it pip's own index
# is taken, and CUDA's gigabytes with it.
ARG TORCH_INDEX=
WORKDIR /flowsplat
COPY pyproject.toml constraints.txt requirements.view.lock README.md LICENSE ./
COPY src src
# Everything has the hash that requirements.view.lock names for it, except for torch, of which the wanted build differs.
RUN pip install --no-cache-dir --no-deps --require-hashes -r requirements.view.lock \
    && pip install --no-cache-dir ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "$(grep '^torch==' constraints.txt)" \
    && pip install --no-cache-dir --no-deps --no-build-isolation .
# Kernels that were compiled, and how fast the machine is: mount a folder here to keep them.
ENV FLOWSPLAT_CACHE=/cache/flowsplat
WORKDIR /data
ENTRYPOINT ["flowsplat"]
