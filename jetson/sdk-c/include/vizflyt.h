/* VizFlyt plugins in C and C++: layout of an observation in shared memory, and four callbacks.
 *
 *   #include "vizflyt.h"
 *   static int on_image(void *user, const VizflytObservation *obs, VizflytSetpoint *answer) {
 *       answer->kind = VIZFLYT_HOLD;
 *       return 1;
 *   }
 *   int main(void) {
 *       VizflytPlugin plugin = {0};
 *       plugin.on_image = on_image;
 *       return vizflyt_run(&plugin);
 *   }
 *
 * Build: cargo build --release -p vizflyt-c
 *        c++ my_plugin.cpp -I jetson/sdk-c/include target/release/libvizflyt_c.a -lpthread -ldl -lm
 * Fly:   vizflyt demo --plugin ./a.out        (or `vizflyt fly ./a.out ...`)
 *
 * Frames: world is x east, y north, z up; body is x forward, y left, z up; camera is x right, y down,
 * z forward. Rotations are unit quaternions in the order x, y, z, w. SI units; angles in radians;
 * times in nanoseconds of CLOCK_MONOTONIC. Little-endian. */
#ifndef VIZFLYT_H
#define VIZFLYT_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

#define VIZFLYT_PROTOCOL_VERSION 13
#define VIZFLYT_MAX_CAMERAS 8
#define VIZFLYT_MAX_SENSORS 8
#define VIZFLYT_MAX_IMU 64
#define VIZFLYT_MAX_WAYPOINTS 32
#define VIZFLYT_MAX_PIECES 8
#define VIZFLYT_MAX_NO_FLY 8

/* ---- observation in shared memory; valid during on_image ---- */

/* One camera. Its planes lie at rgb_offset and depth_offset from the start of the observation. */
typedef struct VizflytCamera {
    uint64_t pose_ns;          /* measurement time of the newest pose behind the image */
    uint64_t ready_ns;         /* time at which the runtime had decoded the image */
    uint64_t seq;              /* server tick that rendered the image */
    double intrinsics_px[4];   /* fx, fy, cx, cy; (0, 0) is the top-left pixel's outer corner */
    double distortion[5];      /* in the order of OpenCV; unused ones are 0 */
    double translation_m[3];   /* camera position in the body */
    double rotation_xyzw[4];   /* camera to body */
    uint32_t width_px;         /* 0: no image of this camera yet */
    uint32_t height_px;
    uint32_t rgb_offset;
    uint32_t depth_offset;
    uint32_t distortion_model; /* 0 none, 1 Brown-Conrady, 2 Kannala-Brandt */
    int32_t ahead_ns;          /* the image shows the instant pose_ns + ahead_ns */
    double body_position_m[3];    /* body at that instant, world; 0 if the course withholds the pose */
    double body_rotation_xyzw[4]; /* body to world at that instant; all 0 if withheld (not a valid rotation) */
} VizflytCamera;

typedef struct VizflytImu {
    uint64_t stamp_ns;
    float accel_mps2[3]; /* specific force, body: at rest and level +9.8 along z */
    float gyro_radps[3]; /* body */
} VizflytImu;

enum {
    VIZFLYT_HAS_ATTITUDE = 1, /* rotation and angular velocity are set */
    VIZFLYT_HAS_POSE = 2      /* position and velocity are set, because the course gives the pose */
};

typedef struct VizflytObservation {
    char magic[4]; /* "VZOB" */
    uint16_t version;
    uint8_t camera_count;
    uint8_t flags;
    uint32_t total_len; /* in bytes, with the planes */
    uint32_t imu_count;
    uint64_t seq;        /* number of the observation; missing numbers were skipped */
    uint64_t vehicle_ns; /* time of the vehicle's state */
    double position_m[3];    /* world; 0 if the course withholds the pose */
    double velocity_mps[3];  /* world; 0 if the course withholds the pose */
    double rotation_xyzw[4]; /* body to world */
    double angular_radps[3]; /* body */
    double battery_fraction; /* 0 to 1; negative if unknown */
    double battery_v;        /* 0 if unknown */
    VizflytImu imu[VIZFLYT_MAX_IMU]; /* newest samples, oldest first; may repeat earlier ones */
    VizflytCamera cameras[VIZFLYT_MAX_CAMERAS];
    uint32_t sensors_offset; /* table of the other sensors, if sensor_count > 0 */
    uint32_t sensor_count;
} VizflytObservation;

/* Kinds of sensors other than cameras. */
enum { VIZFLYT_LIDAR = 1, VIZFLYT_RANGE_FINDER = 2, VIZFLYT_SONAR = 3, VIZFLYT_RADAR = 4 };

/* One sensor and its newest reading: record_count records at records_offset from the start of the observation.
 * A reading stays until the next one arrives; a changed seq marks a new one. Sensor axes: x forward, y left, z up. */
typedef struct VizflytSensor {
    uint64_t seq;              /* number of the reading, from 1; 0: no reading yet */
    uint64_t pose_ns;          /* measurement time of the newest pose behind the reading */
    uint64_t stamp_ns;         /* instant of the reading; end of a sweep */
    uint64_t ready_ns;         /* time at which the runtime received it */
    double translation_m[3];   /* sensor position in the body */
    double rotation_xyzw[4];   /* sensor to body */
    double body_position_m[3];    /* body at that instant, world; 0 if the course withholds the pose */
    double body_rotation_xyzw[4]; /* body to world at that instant; all 0 if withheld (not a valid rotation) */
    uint32_t kind;
    uint32_t record_count;
    uint32_t records_offset;
    uint32_t reserved;
    char name[32]; /* zero-padded; not zero-terminated if 32 bytes long */
} VizflytSensor;

/* One return of a LiDAR. Beams without a return have no point. */
typedef struct VizflytLidarPoint {
    float p_m[3];       /* in the sensor's axes at the time of this beam; not corrected for motion during the sweep */
    uint32_t before_ns; /* time from this beam to stamp_ns */
    uint16_t intensity; /* independent of range; 255: white surface that fills the beam */
    uint16_t ring;
} VizflytLidarPoint;

/* Range finder or sonar: one record per reading. */
typedef struct VizflytRange {
    float range_m; /* along x; 0: no return */
    float signal;  /* power of the echo over the detection threshold */
} VizflytRange;

typedef struct VizflytRadarDetection {
    float range_m;
    float azimuth_rad; /* to the left of x */
    float radial_mps;  /* positive: moving away */
    float snr_db;
    float cross_section_m2;
} VizflytRadarDetection;

/* Returns the sensor with this name, or NULL if it does not exist. */
static inline const VizflytSensor *vizflyt_sensor(const VizflytObservation *obs, const char *name) {
    const VizflytSensor *sensors = (const VizflytSensor *)(const void *)((const uint8_t *)obs + obs->sensors_offset);
    for (uint32_t i = 0; i < obs->sensor_count; i++)
        if (strncmp(sensors[i].name, name, sizeof sensors[i].name) == 0) return &sensors[i];
    return NULL;
}

/* Returns the records of a sensor's newest reading: VizflytLidarPoint, VizflytRange or VizflytRadarDetection, by its
 * kind. NULL if there is no reading yet. */
static inline const void *vizflyt_records(const VizflytObservation *obs, const VizflytSensor *sensor) {
    if (sensor == NULL || sensor->seq == 0) return NULL;
    return (const uint8_t *)obs + sensor->records_offset;
}

/* Returns the colour image, H x W x 3 bytes, sRGB. NULL if there is no image yet. */
static inline const uint8_t *vizflyt_rgb(const VizflytObservation *obs, unsigned camera) {
    if (camera >= obs->camera_count || obs->cameras[camera].width_px == 0) return NULL;
    return (const uint8_t *)obs + obs->cameras[camera].rgb_offset;
}

/* Returns depth along the camera's z, H x W, in millimetres; 0 means no return. NULL if there is no image yet. */
static inline const uint16_t *vizflyt_depth_mm(const VizflytObservation *obs, unsigned camera) {
    if (camera >= obs->camera_count || obs->cameras[camera].width_px == 0) return NULL;
    return (const uint16_t *)(const void *)((const uint8_t *)obs + obs->cameras[camera].depth_offset);
}

/* ---- setpoint that a plugin returns ---- */

enum {
    VIZFLYT_HOLD = 0,
    VIZFLYT_LAND = 1,
    VIZFLYT_POSITION = 2,      /* v: [m, world] */
    VIZFLYT_VELOCITY = 3,      /* v: [m/s, axes] */
    VIZFLYT_ACCELERATION = 4,  /* v: [m/s^2, axes], gravity compensated */
    VIZFLYT_OFFSET = 5,        /* v: [m, axes], relative to the vehicle's position */
    VIZFLYT_ATTITUDE_RATE = 6, /* v: [rad/s, body], and thrust; only if the course allows it */
    VIZFLYT_TAKE_OFF = 7,      /* to the height at which the plugin got control */
    VIZFLYT_WAYPOINTS = 8,     /* id, axes, yaw_kind, waypoints[count] */
    VIZFLYT_POLYNOMIAL = 9     /* id, axes, yaw_kind, pieces[count] */
};
enum { VIZFLYT_WORLD = 0, VIZFLYT_HEADING = 1, VIZFLYT_BODY = 2 };
enum {
    VIZFLYT_YAW_KEEP = 0,
    VIZFLYT_YAW_ANGLE = 1, /* yaw: from world x, counter-clockwise [rad] */
    VIZFLYT_YAW_RATE = 2,  /* yaw: counter-clockwise [rad/s] */
    VIZFLYT_YAW_AHEAD = 3  /* in the direction of travel; only for trajectories */
};

typedef struct VizflytWaypoint {
    double p_m[3];
    double speed_mps; /* maximum on the way to this waypoint */
} VizflytWaypoint;

/* Position after t seconds of the piece is the sum of coefficients[k] * t^k. */
typedef struct VizflytPiece {
    double seconds;
    double coefficients[8][3];
} VizflytPiece;

typedef struct VizflytSetpoint {
    uint32_t kind;
    uint32_t axes;
    uint32_t yaw_kind;
    uint32_t count; /* number of waypoints or pieces */
    double v[3];
    double yaw;
    double thrust; /* thrust / weight: 1 carries the level vehicle */
    uint32_t id;   /* of a trajectory: the same id continues it, another id starts a new one */
    uint32_t reserved;
    const VizflytWaypoint *waypoints; /* copied when on_image returns */
    const VizflytPiece *pieces;
} VizflytSetpoint;

/* ---- the plugin ---- */

enum {
    VIZFLYT_SPHERE = 0,    /* a: centre, radius_m */
    VIZFLYT_CAPSULE = 1,   /* a, b: ends of the axis, radius_m */
    VIZFLYT_BOX = 2,       /* a: centre, b: half of each side, rotation_xyzw: box to world */
    VIZFLYT_HALF_SPACE = 3 /* a: normal, radius_m: offset; all points with normal . p <= offset */
};

/* Solid volume in the world. [m] */
typedef struct VizflytVolume {
    uint32_t kind;
    uint32_t reserved;
    double a[3];
    double b[3];
    double radius_m;
    double rotation_xyzw[4];
} VizflytVolume;

typedef struct VizflytArena {
    uint32_t camera_count;
    uint32_t has_goal;
    double goal_m[3]; /* world */
    double max_speed_mps;
    double max_acceleration_mps2;
    uint32_t ground_truth;  /* 1: observations have VIZFLYT_HAS_POSE */
    uint32_t attitude_rate; /* 1: VIZFLYT_ATTITUDE_RATE is allowed */
    char name[33];
    char cameras[VIZFLYT_MAX_CAMERAS][33]; /* camera names, by index */
    /* Kinds of setpoint that the course allows: 1 << VIZFLYT_POSITION and so on. 1 << VIZFLYT_WAYPOINTS stands for
     * both kinds of trajectory. Hold, land and take-off are always allowed. */
    uint32_t setpoints;
    double floor_z_m;         /* height of the floor, world */
    VizflytVolume geofence;   /* the surface of the vehicle's body must stay inside */
    uint32_t no_fly_count;
    uint32_t map_count;       /* 0: the course does not give the map */
    VizflytVolume no_fly[VIZFLYT_MAX_NO_FLY]; /* the surface of the vehicle's body must stay outside */
    const VizflytVolume *map; /* every obstacle, if map_count > 0; valid during on_start */
} VizflytArena;

/* All callbacks are called from the thread of vizflyt_run, one at a time. They must not throw an exception, and must
 * not keep a pointer that they receive. All except on_image may be NULL. */
typedef struct VizflytPlugin {
    void *user; /* passed to each callback */
    /* Called before the first image, on the ground. */
    void (*on_start)(void *user, const VizflytArena *arena);
    /* Returns 1 with *answer filled in (initially zero: hold), or 0 for no setpoint. */
    int (*on_image)(void *user, const VizflytObservation *obs, VizflytSetpoint *answer);
    /* Called for each event, with a description in words. */
    void (*on_event)(void *user, const char *text);
    /* Called at the end of the flight. */
    void (*on_stop)(void *user);
} VizflytPlugin;

/* Publishes the plugin's estimate of the vehicle's pose at stamp_ns (for an estimate from an image, pass
 * pose_ns + ahead_ns). It is logged, and vizflyt grade reports its error; it does not control the flight. z of its
 * frame is up; you choose origin and heading. Call it in on_image, at most four times. Returns 1, or 0 for an invalid
 * pose or too many calls. */
int vizflyt_publish_odometry(uint64_t stamp_ns, const double p_odom_m[3], const double rotation_xyzw[4]);

/* Attaches to the runtime that started this program and runs until the end of the flight. Returns the
 * exit status for main: 0 after a flight, 1 if the runtime ended unexpectedly, 2 if there is no runtime. */
int vizflyt_run(const VizflytPlugin *plugin);

#ifdef __cplusplus
}
static_assert(sizeof(VizflytCamera) == 232, "layout of the shared memory");
static_assert(sizeof(VizflytImu) == 32, "layout of the shared memory");
static_assert(sizeof(VizflytSensor) == 192, "layout of the shared memory");
static_assert(offsetof(VizflytSensor, kind) == 144, "layout of the shared memory");
static_assert(sizeof(VizflytLidarPoint) == 20, "layout of the shared memory");
static_assert(sizeof(VizflytRange) == 8, "layout of the shared memory");
static_assert(sizeof(VizflytRadarDetection) == 20, "layout of the shared memory");
static_assert(offsetof(VizflytObservation, sensors_offset) == 4056, "layout of the shared memory");
static_assert(sizeof(VizflytObservation) == 4064, "layout of the shared memory");
static_assert(offsetof(VizflytObservation, cameras) == 2200, "layout of the shared memory");
#endif

#endif
