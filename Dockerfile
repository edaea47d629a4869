# The demo by a user of any number: docker build -t shapepose-fg . && docker run --user 12345 shapepose-fg
FROM python:3.11-slim
COPY pyproject.toml constraints.txt README.md LICENSE /src/
COPY factors /src/factors
COPY shapepose_fg /src/shapepose_fg
RUN pip install --no-cache-dir -c /src/constraints.txt "/src[export,archive]" && rm -r /src && mkdir -m 1777 /data
ENV NUMBA_CACHE_DIR=/opt/kernels NUMBA_CPU_NAME=generic
RUN shapepose-fg compile
WORKDIR /data
ENTRYPOINT ["shapepose-fg"]
CMD ["demo"]
