//! 15-state error covariance: prediction and scalar updates.
//!
//! Order of the errors: position [m, world], velocity [m/s, world], attitude [rad, body], gyro bias [rad/s, body],
//! accelerometer bias [m/s^2, body]. Attitude errors multiply on the right: `q_true = q * exp(error)` (Sola,
//! "Quaternion kinematics for the error-state Kalman filter", arXiv 1711.02508, section 5).

use glam::{DMat3, DQuat, DVec3};

/// Number of error states.
pub(super) const N: usize = 15;
/// First index of each group of three.
pub(super) const POSITION: usize = 0;
pub(super) const VELOCITY: usize = 3;
pub(super) const ATTITUDE: usize = 6;
pub(super) const GYRO_BIAS: usize = 9;
pub(super) const ACCEL_BIAS: usize = 12;

/// Noise densities. Larger than those of the sensors, because they also cover vibration and the linear steps of the
/// prediction.
const ACCEL_DENSITY: f64 = 0.05; // [m/s^2 / sqrt(Hz)]
const GYRO_DENSITY: f64 = 0.002; // [rad/s / sqrt(Hz)]
const GYRO_BIAS_WALK: f64 = 2e-4; // [rad/s / sqrt(s)]
const ACCEL_BIAS_WALK: f64 = 3e-3; // [m/s^2 / sqrt(s)]

type Matrix = [[f64; N]; N];

/// Covariance, and the correction that measurements gave but that is not applied yet.
#[derive(Clone, Debug)]
pub(super) struct Covariance {
    p: Box<Matrix>,
    correction: [f64; N],
}

impl Covariance {
    /// Returns a diagonal covariance with one standard deviation per group.
    pub(super) fn new(sigmas: [f64; 5]) -> Self {
        let mut p = Box::new([[0.0; N]; N]);
        for i in 0..N {
            p[i][i] = sigmas[i / 3] * sigmas[i / 3];
        }
        Self { p, correction: [0.0; N] }
    }

    /// Removes all correlations of one axis and sets its standard deviation.
    pub(super) fn reset(&mut self, index: usize, sigma: f64) {
        for i in 0..N {
            self.p[index][i] = 0.0;
            self.p[i][index] = 0.0;
        }
        self.p[index][index] = sigma * sigma;
    }

    /// Adds variance to one error.
    pub(super) fn inflate_variance(&mut self, index: usize, sigma: f64) {
        self.p[index][index] += sigma * sigma;
    }

    /// Propagates the covariance over `dt_s` of flight with a specific force and a turn rate.
    pub(super) fn predict(
        &mut self,
        world_from_body: DQuat,
        accel_body: DVec3,
        omega_body: DVec3,
        dt_s: f64,
    ) {
        let rotation = DMat3::from_quat(world_from_body);
        let mut f: Matrix = [[0.0; N]; N];
        for i in 0..N {
            f[i][i] = 1.0;
        }
        let mut add = |row: usize, column: usize, m: DMat3| {
            for c in 0..3 {
                for r in 0..3 {
                    f[row + r][column + c] += m.col(c)[r] * dt_s;
                }
            }
        };
        add(POSITION, VELOCITY, DMat3::IDENTITY);
        add(VELOCITY, ATTITUDE, -(rotation * skew(accel_body)));
        add(VELOCITY, ACCEL_BIAS, -rotation);
        add(ATTITUDE, ATTITUDE, -skew(omega_body));
        add(ATTITUDE, GYRO_BIAS, -DMat3::IDENTITY);
        let half = product(&f, &self.p);
        *self.p = product_transposed(&half, &f);
        let grow = |density: f64| density * density * dt_s;
        for i in 0..3 {
            self.p[VELOCITY + i][VELOCITY + i] += grow(ACCEL_DENSITY);
            self.p[ATTITUDE + i][ATTITUDE + i] += grow(GYRO_DENSITY);
            self.p[GYRO_BIAS + i][GYRO_BIAS + i] += grow(GYRO_BIAS_WALK);
            self.p[ACCEL_BIAS + i][ACCEL_BIAS + i] += grow(ACCEL_BIAS_WALK);
        }
    }

    /// Returns the innovation of one scalar measurement divided by its expected deviation. `innovation` is measured
    /// minus expected; `row` contains its derivatives by the errors as (index, value).
    pub(super) fn normalized_innovation(
        &self,
        row: &[(usize, f64)],
        innovation: f64,
        sigma: f64,
    ) -> f64 {
        let variance: f64 = row
            .iter()
            .flat_map(|&(i, hi)| row.iter().map(move |&(j, hj)| hi * hj * self.p[i][j]))
            .sum();
        innovation / (variance + sigma * sigma).sqrt()
    }

    /// Fuses one scalar measurement. The correction is returned by [`Self::take_correction`].
    pub(super) fn fuse(&mut self, row: &[(usize, f64)], innovation: f64, sigma: f64) {
        let mut ph = [0.0; N];
        for (i, value) in ph.iter_mut().enumerate() {
            *value = row.iter().map(|&(j, h)| self.p[i][j] * h).sum();
        }
        let variance: f64 = row.iter().map(|&(i, h)| h * ph[i]).sum::<f64>() + sigma * sigma;
        if !(variance > 1e-12) {
            return;
        }
        let expected: f64 = row.iter().map(|&(i, h)| h * self.correction[i]).sum();
        for i in 0..N {
            let gain = ph[i] / variance;
            self.correction[i] += gain * (innovation - expected);
            for j in 0..N {
                self.p[i][j] -= gain * ph[j];
            }
        }
        // Rounding must not make the matrix indefinite: keep it symmetric with a positive diagonal.
        for i in 0..N {
            for j in 0..i {
                let mean = 0.5 * (self.p[i][j] + self.p[j][i]);
                self.p[i][j] = mean;
                self.p[j][i] = mean;
            }
            self.p[i][i] = self.p[i][i].max(1e-12);
        }
    }

    /// Returns the accumulated correction of each group, and clears it.
    pub(super) fn take_correction(&mut self) -> [DVec3; 5] {
        let c = std::mem::replace(&mut self.correction, [0.0; N]);
        std::array::from_fn(|g| DVec3::new(c[3 * g], c[3 * g + 1], c[3 * g + 2]))
    }

    /// Whether all variances are finite.
    pub(super) fn is_finite(&self) -> bool {
        (0..N).all(|i| self.p[i][i].is_finite())
    }

    /// Returns the standard deviation of one error.
    pub(super) fn sigma(&self, index: usize) -> f64 {
        self.p[index][index].sqrt()
    }
}

/// Returns the matrix m with m v = a x v.
fn skew(a: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, a.z, -a.y),
        DVec3::new(-a.z, 0.0, a.x),
        DVec3::new(a.y, -a.x, 0.0),
    )
}

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    let mut out = [[0.0; N]; N];
    for i in 0..N {
        for k in 0..N {
            let aik = a[i][k];
            // Most of the transition matrix is zero.
            if aik != 0.0 {
                for j in 0..N {
                    out[i][j] += aik * b[k][j];
                }
            }
        }
    }
    out
}

fn product_transposed(a: &Matrix, b: &Matrix) -> Matrix {
    let mut transposed = [[0.0; N]; N];
    for i in 0..N {
        for j in 0..N {
            transposed[j][i] = b[i][j];
        }
    }
    product(a, &transposed)
}
