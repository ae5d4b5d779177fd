// The inner ray loop of taichi_mrf/inference/sum_product.py in plain C++, to tell whether the code that
// Taichi generates is the limit or the machine is. walk.py compiles it and compares the sums that come out.
//
// A ray walks through a dense grid of voxels (Amanatides & Woo), stored as bricks of 8^3. Forward: each step's
// length, chance of being free, density and explanation so far go into a trace of 20 bytes a step. Backward:
// one logarithm and one 64-bit atomic addition a step.
//
// walk FILE THREADS: FILE holds two int32 (bricks along each side, rays), four float32 (sigma, floor, clamp,
// scale), log_free (float32 a voxel), and ten float32 for each ray: origin, direction, begin, end, measured,
// voxels for one unit of the ray's parameter. Writes FILE.sums (int64 a voxel); prints seconds and steps.

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <thread>
#include <vector>

struct Ray { float origin[3], direction[3], begin, end, measured, voxels; };
struct Step { float length, free, density, before; };
struct Header { int32_t bricks, rays; float sigma, floor, clamp, scale; };

static const float TINY = 1e-30f, FAR = 1e30f;
static const int RUN = 256;  // neighbouring rays that one thread takes at a time

static float exp_of_negative(float x) {
    return x > -0.05f ? 1 + x * (1 + x * (0.5f + x * (1.0f / 6))) : std::exp(x);
}

static long walk(const Header& h, const Ray& ray, const std::vector<float>& log_free,
                 std::vector<std::atomic<int64_t>>& sums, std::vector<int32_t>& voxels, std::vector<Step>& trace) {
    const int side = h.bricks * 8;
    int cell[3], step[3];
    float leave[3], delta[3];
    for (int a = 0; a < 3; ++a) {
        const float inverse = std::abs(ray.direction[a]) > 1e-12f ? 1 / ray.direction[a] : FAR;
        step[a] = ray.direction[a] < -1e-12f ? -1 : 1;
        cell[a] = std::clamp(int(std::floor(ray.origin[a] + ray.begin * ray.direction[a])), 0, side - 1);
        leave[a] = (cell[a] + (step[a] > 0) - ray.origin[a]) * inverse;
        delta[a] = std::abs(inverse);
    }
    float t = ray.begin, visibility = 1, explained = 0;
    const float support = ray.measured - 6.5f * h.sigma;
    int n = 0;
    while (t < ray.end && ((cell[0] | cell[1] | cell[2]) >= 0) && std::max({cell[0], cell[1], cell[2]}) < side) {
        const float next = std::min({leave[0], leave[1], leave[2]}), to = std::min(next, ray.end);
        if (to > t) {
            const int brick = ((cell[0] >> 3) * h.bricks + (cell[1] >> 3)) * h.bricks + (cell[2] >> 3);
            const int voxel = brick * 512 + ((cell[0] & 7) * 8 + (cell[1] & 7)) * 8 + (cell[2] & 7);
            const float length = (to - t) * ray.voxels;
            float density = 0;
            if (to > support) {
                const float z = (ray.measured - 0.5f * (t + to)) / h.sigma;
                density = 0.3989422804014327f * std::exp(-0.5f * z * z) / h.sigma * visibility;
            }
            const float free = exp_of_negative(log_free[voxel] * length);
            voxels[n] = voxel;
            trace[n++] = {length, free, density, explained};
            explained += (1 - free) * density;
            visibility *= free;
            t = to;
        }
        const int a = leave[0] <= next ? 0 : leave[1] <= next ? 1 : 2;
        cell[a] += step[a];
        leave[a] += delta[a];
    }
    const float largest = std::exp(h.clamp);
    float behind = 0;
    for (int j = n - 1; j >= 0; --j) {
        const Step& s = trace[j];
        const float occupied = s.before + s.density + (h.floor + TINY);
        const float empty = s.before + behind / std::max(s.free, TINY) + (h.floor + TINY);
        float message = 1;
        if (occupied * largest <= empty) message = 0;
        else if (occupied < empty * largest) message = 0.5f + 0.5f * std::log(occupied / empty) / h.clamp;
        behind += (1 - s.free) * s.density;
        const int64_t lengths = int64_t(s.length * h.scale + 0.5f);
        const int64_t messages = int64_t(s.length * message * h.scale + 0.5f);
        sums[voxels[j]].fetch_add((messages << 32) + lengths, std::memory_order_relaxed);
    }
    return n;
}

int main(int count, char** arguments) {
    if (count != 3) return std::fprintf(stderr, "usage: walk FILE THREADS\n"), 2;
    std::FILE* file = std::fopen(arguments[1], "rb");
    const int threads = std::atoi(arguments[2]);
    Header h;
    if (!file || std::fread(&h, sizeof h, 1, file) != 1) return std::fprintf(stderr, "no input\n"), 2;
    const size_t n = size_t(h.bricks) * h.bricks * h.bricks * 512;
    std::vector<float> log_free(n);
    std::vector<Ray> rays(h.rays);
    if (std::fread(log_free.data(), 4, n, file) != n ||
        std::fread(rays.data(), sizeof(Ray), rays.size(), file) != rays.size())
        return std::fprintf(stderr, "the input is cut short\n"), 2;
    std::fclose(file);
    std::vector<std::atomic<int64_t>> sums(n);
    double best = 1e30;
    long steps = 0;
    for (int attempt = 0; attempt < 6; ++attempt) {  // the first warms the caches
        for (auto& sum : sums) sum.store(0, std::memory_order_relaxed);
        std::atomic<long> all{0};
        std::vector<std::thread> team;
        const auto begin = std::chrono::steady_clock::now();
        for (int worker = 0; worker < threads; ++worker)
            team.emplace_back([&, worker] {
                std::vector<int32_t> voxels(h.bricks * 24 + 8);
                std::vector<Step> trace(voxels.size());
                long mine = 0;
                for (int first = worker * RUN; first < h.rays; first += threads * RUN)
                    for (int i = first; i < std::min(first + RUN, h.rays); ++i)
                        mine += walk(h, rays[i], log_free, sums, voxels, trace);
                all += mine;
            });
        for (auto& thread : team) thread.join();
        const std::chrono::duration<double> took = std::chrono::steady_clock::now() - begin;
        if (attempt > 0) best = std::min(best, took.count());
        steps = all;
    }
    file = std::fopen((std::string(arguments[1]) + ".sums").c_str(), "wb");
    if (!file || std::fwrite(sums.data(), 8, n, file) != n) return std::fprintf(stderr, "cannot write\n"), 2;
    std::fclose(file);
    std::printf("%.9f %ld\n", best, steps);
}
