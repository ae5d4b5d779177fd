# The built-in room on the live page at http://localhost:8080, on a CPU:
#   docker build -t taichi_mrf . && docker run --rm -p 127.0.0.1:8080:8080 taichi_mrf
# Any other command, on a CUDA device, with recordings and maps in the current folder:
#   docker run --rm --gpus all -v "$PWD:/maps" taichi_mrf map recording --out desk
FROM python:3.12-slim

# Of Taichi's backends, CUDA comes with --gpus all; this is the loader of Vulkan.
RUN apt-get update && apt-get install -y --no-install-recommends libvulkan1 && rm -rf /var/lib/apt/lists/*
ENV NVIDIA_DRIVER_CAPABILITIES=all

COPY . /source
RUN pip install --no-cache-dir "/source[auto,las,ros,store]" && rm -rf /source

WORKDIR /maps
VOLUME /maps
EXPOSE 8080
ENTRYPOINT ["taichi-mrf"]
# In a container the page must be served at all addresses; `docker run -p 127.0.0.1:8080:8080` keeps it on this machine.
CMD ["live", "--host", "0.0.0.0"]
