/* VizFlyt plugins in C and C++: the layout of an observation in shared memory, and four callbacks.
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

/* ---- an observation, as it lies in shared memory; valid during on_image ---- */

/* One camera. Its planes lie at rgb_offset and depth_offset from the start of the observation. */
typedef struct VizflytCamera {
    uint64_t pose_ns;          /* when the newest pose behind the image was measured */
    uint64_t ready_ns;         /* when the runtime had the decoded image */
    uint64_t seq;              /* tick of the server that made the image */
    double intrinsics_px[4];   /* fx, fy, cx, cy; (0, 0) is the top-left pixel's outer corner */
    double distortion[5];      /* in the order of OpenCV, the rest 0 */
    double translation_m[3];   /* of the camera in the body */
    double rotation_xyzw[4];   /* camera to body */
    uint32_t width_px;         /* 0: this camera has no image yet */
    uint32_t height_px;
    uint32_t rgb_offset;
    uint32_t depth_offset;
    uint32_t distortion_model; /* 0 none, 1 Brown-Conrady, 2 Kannala-Brandt */
    int32_t ahead_ns;          /* by how much later than pose_ns the instant is that the image shows */
    double body_position_m[3];    /* of the body at that instant, world; zero where the course withholds it */
    double body_rotation_xyzw[4]; /* body to world at that instant; likewise: no rotation is all zero */
} VizflytCamera;

typedef struct VizflytImu {
    uint64_t stamp_ns;
    float accel_mps2[3]; /* specific force, body: at rest and level +9.8 along z */
    float gyro_radps[3]; /* body */
} VizflytImu;

enum {
    VIZFLYT_HAS_ATTITUDE = 1, /* rotation and angular velocity are filled in */
    VIZFLYT_HAS_POSE = 2      /* so are position and velocity: the course gives them */
};

typedef struct VizflytObservation {
    char magic[4]; /* "VZOB" */
    uint16_t version;
    uint8_t camera_count;
    uint8_t flags;
    uint32_t total_len; /* bytes, planes included */
    uint32_t imu_count;
    uint64_t seq;        /* counts observations; numbers missing were skipped */
    uint64_t vehicle_ns; /* when the vehicle's state was true */
    double position_m[3];    /* world; zero where the course withholds it */
    double velocity_mps[3];  /* world; likewise */
    double rotation_xyzw[4]; /* body to world */
    double angular_radps[3]; /* body */
    double battery_fraction; /* 0 to 1; negative if unknown */
    double battery_v;        /* 0 if unknown */
    VizflytImu imu[VIZFLYT_MAX_IMU]; /* the newest, oldest first; those had before come again */
    VizflytCamera cameras[VIZFLYT_MAX_CAMERAS];
    uint32_t sensors_offset; /* of the table of sensors beside the cameras, if there are any */
    uint32_t sensor_count;
} VizflytObservation;

/* Kinds of sensors beside the cameras. */
enum { VIZFLYT_LIDAR = 1, VIZFLYT_RANGE_FINDER = 2, VIZFLYT_SONAR = 3, VIZFLYT_RADAR = 4 };

/* One sensor and its newest reading: record_count records at records_offset from the start of the observation. A reading
 * stays until the next one comes: seq tells whether it is new. Sensor axes: x forward, y left, z up. */
typedef struct VizflytSensor {
    uint64_t seq;              /* counts readings from 1; 0: none yet */
    uint64_t pose_ns;          /* when the newest pose behind the reading was measured */
    uint64_t stamp_ns;         /* the instant that the reading is of; a sweep's last */
    uint64_t ready_ns;         /* when the runtime had it */
    double translation_m[3];   /* of the sensor in the body */
    double rotation_xyzw[4];   /* sensor to body */
    double body_position_m[3];    /* of the body at that instant, world; zero where the course withholds it */
    double body_rotation_xyzw[4]; /* body to world at that instant; likewise: no rotation is all zero */
    uint32_t kind;
    uint32_t record_count;
    uint32_t records_offset;
    uint32_t reserved;
    char name[32]; /* zeros behind it; of 32 bytes none */
} VizflytSensor;

/* One return of a LiDAR; beams without a return have none. */
typedef struct VizflytLidarPoint {
    float p_m[3];       /* in the sensor's axes when this beam was fired: not corrected for motion during the sweep */
    uint32_t before_ns; /* how long before stamp_ns the beam was fired */
    uint16_t intensity; /* freed of range: 255 of a white surface across the whole beam */
    uint16_t ring;
} VizflytLidarPoint;

/* Of a range finder and a sonar: one per reading. */
typedef struct VizflytRange {
    float range_m; /* along x; 0: nothing came back */
    float signal;  /* power of the echo over the detection threshold */
} VizflytRange;

typedef struct VizflytRadarDetection {
    float range_m;
    float azimuth_rad; /* to the left of x */
    float radial_mps;  /* positive: it goes away */
    float snr_db;
    float cross_section_m2;
} VizflytRadarDetection;

/* Returns the sensor of this name; NULL if there is none. */
static inline const VizflytSensor *vizflyt_sensor(const VizflytObservation *obs, const char *name) {
    const VizflytSensor *sensors = (const VizflytSensor *)(const void *)((const uint8_t *)obs + obs->sensors_offset);
    for (uint32_t i = 0; i < obs->sensor_count; i++)
        if (strncmp(sensors[i].name, name, sizeof sensors[i].name) == 0) return &sensors[i];
    return NULL;
}

/* Returns the records of a sensor's newest reading: VizflytLidarPoint, VizflytRange or VizflytRadarDetection, by its kind;
 * NULL if it has none yet. */
static inline const void *vizflyt_records(const VizflytObservation *obs, const VizflytSensor *sensor) {
    if (sensor == NULL || sensor->seq == 0) return NULL;
    return (const uint8_t *)obs + sensor->records_offset;
}

/* Returns the colour image, H x W x 3 bytes, sRGB; NULL if the camera has none yet. */
static inline const uint8_t *vizflyt_rgb(const VizflytObservation *obs, unsigned camera) {
    if (camera >= obs->camera_count || obs->cameras[camera].width_px == 0) return NULL;
    return (const uint8_t *)obs + obs->cameras[camera].rgb_offset;
}

/* Returns depth along the camera's z, H x W, in millimetres; 0 is no return. NULL as above. */
static inline const uint16_t *vizflyt_depth_mm(const VizflytObservation *obs, unsigned camera) {
    if (camera >= obs->camera_count || obs->cameras[camera].width_px == 0) return NULL;
    return (const uint16_t *)(const void *)((const uint8_t *)obs + obs->cameras[camera].depth_offset);
}

/* ---- what a plugin answers ---- */

enum {
    VIZFLYT_HOLD = 0,
    VIZFLYT_LAND = 1,
    VIZFLYT_POSITION = 2,      /* v: [m, world] */
    VIZFLYT_VELOCITY = 3,      /* v: [m/s, axes] */
    VIZFLYT_ACCELERATION = 4,  /* v: [m/s^2, axes], gravity compensated */
    VIZFLYT_OFFSET = 5,        /* v: [m, axes], from where the vehicle is */
    VIZFLYT_ATTITUDE_RATE = 6, /* v: [rad/s, body], and thrust; only where the course allows */
    VIZFLYT_TAKE_OFF = 7,      /* to the height at which the plugin took over */
    VIZFLYT_WAYPOINTS = 8,     /* id, axes, yaw_kind, waypoints[count] */
    VIZFLYT_POLYNOMIAL = 9     /* id, axes, yaw_kind, pieces[count] */
};
enum { VIZFLYT_WORLD = 0, VIZFLYT_HEADING = 1, VIZFLYT_BODY = 2 };
enum {
    VIZFLYT_YAW_KEEP = 0,
    VIZFLYT_YAW_ANGLE = 1, /* yaw: from world x, counter-clockwise [rad] */
    VIZFLYT_YAW_RATE = 2,  /* yaw: counter-clockwise [rad/s] */
    VIZFLYT_YAW_AHEAD = 3  /* into the direction of travel; trajectories only */
};

typedef struct VizflytWaypoint {
    double p_m[3];
    double speed_mps; /* greatest on the way to it */
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
    uint32_t count; /* of waypoints or pieces */
    double v[3];
    double yaw;
    double thrust; /* over weight: 1 carries the level vehicle */
    uint32_t id;   /* of a trajectory: the same goes on, another one starts anew */
    uint32_t reserved;
    const VizflytWaypoint *waypoints; /* read before on_image's caller goes on, not kept */
    const VizflytPiece *pieces;
} VizflytSetpoint;

/* ---- the plugin ---- */

enum {
    VIZFLYT_SPHERE = 0,    /* a: centre, radius_m */
    VIZFLYT_CAPSULE = 1,   /* a, b: ends of the axis, radius_m */
    VIZFLYT_BOX = 2,       /* a: centre, b: half of each side, rotation_xyzw: of the box into the world */
    VIZFLYT_HALF_SPACE = 3 /* a: normal, radius_m: offset; all points with normal . p <= offset */
};

/* A solid in the world. [m] */
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
    char cameras[VIZFLYT_MAX_CAMERAS][33]; /* their names, by index */
    /* Kinds of setpoint that the course allows: 1 << VIZFLYT_POSITION and so on; trajectories of both
     * kinds are 1 << VIZFLYT_WAYPOINTS. To hold, land and take off is always allowed. */
    uint32_t setpoints;
    double floor_z_m;         /* height of the floor, world */
    VizflytVolume geofence;   /* keep the body's surface in it */
    uint32_t no_fly_count;
    uint32_t map_count;       /* 0: the map is not known */
    VizflytVolume no_fly[VIZFLYT_MAX_NO_FLY]; /* keep the body's surface out of them */
    const VizflytVolume *map; /* every obstacle, where the map is known; valid during on_start */
} VizflytArena;

/* All are called from the thread of vizflyt_run, one at a time. None may let an exception out, nor
 * keep a pointer it was given. Any but on_image may be NULL. */
typedef struct VizflytPlugin {
    void *user; /* handed back to each */
    /* Before the first image, on the ground. */
    void (*on_start)(void *user, const VizflytArena *arena);
    /* Returns 1 with *answer filled in (it comes zeroed: hold), 0 for no answer. */
    int (*on_image)(void *user, const VizflytObservation *obs, VizflytSetpoint *answer);
    /* Something happened; a sentence for a person. */
    void (*on_event)(void *user, const char *text);
    /* At the end of the flight. */
    void (*on_stop)(void *user);
} VizflytPlugin;

/* Publishes where the plugin thinks the vehicle was at stamp_ns (of an estimate from an image: pose_ns + ahead_ns).
 * It is logged, and vizflyt grade reports how far off it was; nothing is flown by it. z of its frame is up; origin
 * and heading are yours. Call it in on_image, four times at most. Returns 1, or 0 for what is no pose or too many. */
int vizflyt_publish_odometry(uint64_t stamp_ns, const double p_odom_m[3], const double rotation_xyzw[4]);

/* Attaches to the runtime that started this program and runs to the end of the flight. Returns the
 * exit status for main: 0 after a flight, 1 if the runtime vanished, 2 if there is none. */
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
