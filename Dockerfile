# jetnormal with all its extras and compiled loops:
#
#     docker build -t jetnormal .
#     docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" jetnormal estimate scan.ply -o scan_normals.ply
#
# On x86-64, PyTorch's default package brings several GB of CUDA libraries. For an image without them, pass the address
# of its CPU packages, which PyTorch's "Get started" page names: --build-arg TORCH_INDEX=ADDRESS
FROM python:3.12-slim

ARG TORCH_INDEX=""
# Open3D needs libGL, libEGL and libgomp.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

COPY . /opt/jetnormal
# Once compiled, the loops serve every later run on a machine of the same kind; on another, they are compiled again.
ENV NUMBA_CACHE_DIR=/opt/cache
RUN pip install --no-cache-dir --constraint /opt/jetnormal/constraints.txt \
        ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} '/opt/jetnormal[all]' \
    && jetnormal estimate /opt/jetnormal/samples/milk.pcd -o /tmp/milk.ply --confidence --curvature \
    && rm -r /tmp/milk.ply /opt/jetnormal \
    && chmod -R a+rwX /opt/cache

# No user of a name is needed: the command runs as whoever owns the mounted folder.
ENV HOME=/tmp
WORKDIR /data
ENTRYPOINT ["jetnormal"]
CMD ["--help"]
