# docker build -t minisplat-ref .
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" minisplat-ref photos PHOTOS --out mine
FROM python:3.13-slim
COPY . /source
RUN pip install --no-cache-dir '/source[photos,compression,video]' && rm -r /source
# Where any user may write: kernels that Numba compiles, and the folder that a user gives.
ENV NUMBA_CACHE_DIR=/tmp/kernels HOME=/tmp
WORKDIR /data
ENTRYPOINT ["minisplat-ref"]
