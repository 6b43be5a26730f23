// Flies forward at a speed that depends on the free distance, and turns at obstacles: a C++ plugin on vizflyt.h.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>

#include "vizflyt.h"

namespace {

struct Brake {
    unsigned camera = 0;
    unsigned long images = 0;
    double max_speed_mps = 1.0;
};

void on_start(void *user, const VizflytArena *arena) {
    auto *self = static_cast<Brake *>(user);
    self->max_speed_mps = std::min(1.0, arena->max_speed_mps);
    for (unsigned i = 0; i < arena->camera_count; ++i)
        if (std::strcmp(arena->cameras[i], "front") == 0) self->camera = i;
    std::printf("flying in %s: floor at %g m, %u no-fly boxes, a map of %u, velocities %s\n",
                arena->name, arena->floor_z_m, arena->no_fly_count, arena->map_count,
                arena->setpoints & (1u << VIZFLYT_VELOCITY) ? "allowed" : "refused");
    std::fflush(stdout);
}

// Returns the smallest depth in the middle ninth of the image, in metres; 20 without a return.
double nearest_m(const VizflytObservation *obs, unsigned camera) {
    const VizflytCamera &head = obs->cameras[camera];
    const uint16_t *depth_mm = vizflyt_depth_mm(obs, camera);
    double nearest = 20.0;
    for (uint32_t y = head.height_px / 3; y < 2 * head.height_px / 3; ++y)
        for (uint32_t x = head.width_px / 3; x < 2 * head.width_px / 3; ++x)
            if (const uint16_t mm = depth_mm[y * head.width_px + x])
                nearest = std::min(nearest, mm / 1000.0);
    return nearest;
}

// Returns the nearest distance ahead of a range finder "ahead" and a LiDAR "top", in metres; 20 without them.
double sensed_m(const VizflytObservation *obs) {
    double nearest = 20.0;
    const VizflytSensor *ahead = vizflyt_sensor(obs, "ahead");
    if (const void *records = vizflyt_records(obs, ahead))
        if (const auto *range = static_cast<const VizflytRange *>(records); range->range_m > 0)
            nearest = range->range_m;
    const VizflytSensor *top = vizflyt_sensor(obs, "top");
    if (const auto *points = static_cast<const VizflytLidarPoint *>(vizflyt_records(obs, top)))
        for (uint32_t i = 0; i < top->record_count; ++i)
            if (points[i].p_m[0] > std::abs(points[i].p_m[1])) nearest = std::min<double>(nearest, points[i].p_m[0]);
    return nearest;
}

int on_image(void *user, const VizflytObservation *obs, VizflytSetpoint *answer) {
    auto *self = static_cast<Brake *>(user);
    if (!vizflyt_depth_mm(obs, self->camera)) return 0;
    ++self->images;
    const double free_m = std::min(nearest_m(obs, self->camera), sensed_m(obs)) - 1.0;
    answer->kind = VIZFLYT_VELOCITY;
    answer->axes = VIZFLYT_HEADING;
    answer->v[0] = std::clamp(0.5 * free_m, 0.0, self->max_speed_mps);
    answer->yaw_kind = free_m < 0.5 ? VIZFLYT_YAW_RATE : VIZFLYT_YAW_KEEP;
    answer->yaw = 0.5;
    return 1;
}

void on_stop(void *user) {
    std::printf("stopped after %lu images\n", static_cast<Brake *>(user)->images);
    std::fflush(stdout);
}

}  // namespace

int main() {
    Brake brake;
    VizflytPlugin plugin = {};
    plugin.user = &brake;
    plugin.on_start = on_start;
    plugin.on_image = on_image;
    plugin.on_stop = on_stop;
    return vizflyt_run(&plugin);
}
