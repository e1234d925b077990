// Velocity of a legged robot's trunk from its IMU, its joints and its feet's contacts: a linear Kalman
// filter in the world frame. docs/estimation.md derives it; tests/kalman.py is the same law in NumPy.
//
// State x (24): position r and velocity v of the IMU, bias b of its accelerometer (IMU frame), feet p0..p3, height g of
// the ground below r and its slope m along x and y.
// Every matrix has a fixed size: an update allocates nothing and throws nothing.
#pragma once

#include <algorithm>
#include <limits>

#include "legs.hpp"

namespace go1exp {

constexpr int kLegs = 4;
constexpr int kJoints = 3 * kLegs;
constexpr int kGround = 9 + 3 * kLegs;
constexpr int kStates = kGround + 3;
constexpr double kGravity = 9.81;  // m/s2

// No sensor of a legged robot reads more: a finite number beyond them is as broken as NaN (chosen).
constexpr double kMostAcceleration = 1e3, kMostTurning = 1e2, kMostAngle = 1e2, kMostSpeed = 1e3;

using State = Eigen::Matrix<double, kStates, 1>;
using Covariance = Eigen::Matrix<double, kStates, kStates>;
using Joints = Eigen::Matrix<double, kJoints, 1>;
using Vec4 = Eigen::Vector4d;

// s, period of the Go1's sensors. foot_speed_noise is that of samples so far apart: feet that give way do so however often
// one looks. An accelerometer's sample stands for as long.
constexpr double kPeriod = 0.002;

// So many late samples in a row, and it was the clock that jumped: one wrong stamp far ahead must not stop the filter.
constexpr int kMostLate = 10;

enum class Source { force = 0, torque = 1, height = 2 };  // what tells that a foot carries
enum class Status { ok = 0, started = 1, restarted = 2, late = 3, invalid = 4 };

// The fields are those of go1exp.deploy.estimation.config.FilterConfig, which documents them.
struct Settings {
  std::array<Leg, kLegs> legs;
  Vec3 imu_position = Vec3::Zero();
  double foot_radius = 0.0;
  Source contact_source = Source::force;
  double contact_low = 0.0, contact_high = 1.0, contact_least = 0.1, settle = 0.0;
  double acceleration_noise = 1.0, impact_acceleration = 1.0, bias_walk = 0.0;
  double attitude_time = 0.0, attitude_noise = 0.0, gyro_noise = 0.0, joint_noise = 0.0, joint_speed_noise = 0.0;
  double leg_noise = 0.01, foot_drift = 0.01, foot_speed_noise = 0.0, sinking = 1.0, level_noise = 0.0, ground_walk = 0.0, slope_walk = 0.0;
  double initial_speed = 0.1, initial_bias = 0.1;
  double gate = 16.0, longest_gap = 0.1, lost_after = 0.5;
};

struct Sample {
  double t;           // s
  Vec4 quat;          // w-x-y-z, trunk to world
  Vec3 gyro;          // rad/s
  Vec3 acc;           // m/s2, specific force
  Joints q, qd, tau;  // rad, rad/s, N m
  Vec4 foot_force;    // N
};

inline Mat3 cross_matrix(const Vec3& a) {
  Mat3 m;
  m << 0.0, -a[2], a[1], a[2], 0.0, -a[0], -a[1], a[0], 0.0;
  return m;
}

class Filter {
 public:
  explicit Filter(const Settings& settings)
      : c_(settings), speeds_(settings.foot_radius > 0.0 || settings.foot_speed_noise > 0.0) {
    reset();
  }

  // Forgets everything; the next good sample starts the filter.
  void reset() {
    running_ = false;
    x_.setZero();
    P_.setZero();
    contact_.setZero();
    age_.setZero();
    unseen_ = 0.0;
    late_ = 0;
    time_ = -std::numeric_limits<double>::infinity();
    attitude_.setIdentity();
    rot_.setIdentity();
    gyro_.setZero();
    force_.setZero();
  }

  // Takes a sample. One that is `late` or `invalid` does not touch the state.
  Status update(const Sample& s) {
    if (!usable(s)) return Status::invalid;
    const bool late = s.t <= time_;
    if (late && ++late_ < kMostLate) return Status::late;
    const double dt = s.t - time_;
    late_ = 0;
    time_ = s.t;
    gyro_ = s.gyro;
    const bool anew = !running_ || late || dt > c_.longest_gap;
    turn(s, anew ? std::numeric_limits<double>::infinity() : dt);
    look_at_feet(s, anew ? kPeriod : dt);
    if (anew) force_ = rot_ * s.acc;
    if (!running_) {
      start();
      return Status::started;
    }
    if (anew) {  // what the trunk did meanwhile is not known: keep the place, ask the feet anew
      widen_speed();
      for (int leg = 0; leg < kLegs; ++leg) anchor(leg);
      age_.setZero();
      return Status::restarted;
    }
    predict(s.acc, dt);
    correct(dt);
    return Status::ok;
  }

  bool running() const { return running_; }
  double time() const { return time_; }
  Vec3 velocity_w() const { return x_.segment<3>(3) - rot_ * gyro_.cross(c_.imu_position); }
  Vec3 velocity_b() const { return rot_.transpose() * velocity_w(); }
  Vec3 position_w() const { return x_.head<3>() - rot_ * c_.imu_position; }
  const State& state() const { return x_; }
  const Covariance& covariance() const { return P_; }
  const Vec4& contact() const { return contact_; }

 private:
  template <typename Vector>
  static bool within(const Vector& values, double most) {  // false for NaN too
    return (values.array().abs() <= most).all();
  }

  bool usable(const Sample& s) const {
    const bool loads = c_.contact_source == Source::force    ? s.foot_force.allFinite()
                       : c_.contact_source == Source::torque ? s.tau.allFinite()
                                                             : true;
    return std::isfinite(s.t) && std::abs(s.quat.norm() - 1.0) < 0.1 && within(s.gyro, kMostTurning) &&
           within(s.acc, kMostAcceleration) && within(s.q, kMostAngle) && (!speeds_ || within(s.qd, kMostSpeed)) && loads;
  }

  // Attitude: the last one turned by the gyro, drawn towards the one that the IMU reports within attitude_time.
  void turn(const Sample& s, double dt) {
    Eigen::Quaterniond reported(s.quat[0], s.quat[1], s.quat[2], s.quat[3]);
    reported.normalize();
    if (std::isfinite(dt) && c_.attitude_time > 0.0) {
      const Vec3 half = 0.5 * dt * s.gyro;
      const Eigen::Quaterniond turned = attitude_ * Eigen::Quaterniond(1.0, half[0], half[1], half[2]).normalized();
      const double keep = std::exp(-dt / c_.attitude_time), sign = turned.dot(reported) < 0.0 ? -1.0 : 1.0;
      attitude_.coeffs() = keep * turned.coeffs() + (1.0 - keep) * sign * reported.coeffs();
      attitude_.normalize();
    } else {
      attitude_ = reported;
    }
    rot_ = attitude_.toRotationMatrix();
  }

  // Feet against the IMU, in the world's axes: s_, their velocity u_ with the IMU held, that of a rolling foot, noises.
  void look_at_feet(const Sample& s, double dt) {
    Vec4 load;
    for (int leg = 0; leg < kLegs; ++leg) {
      const Foot foot = c_.legs[leg].at(s.q.segment<3>(3 * leg));
      const Vec3 arm = foot.position - c_.imu_position;
      const Vec3 speed = speeds_ ? Vec3(s.qd.segment<3>(3 * leg)) : Vec3(Vec3::Zero());
      arm_[leg] = rot_ * arm;
      moving_[leg] = rot_ * (s.gyro.cross(arm) + foot.jacobian * speed);
      rolling_[leg] = c_.foot_radius * (rot_ * (s.gyro + foot.turning * speed)).cross(Vec3::UnitZ());
      const Mat3 J = rot_ * foot.jacobian, A = cross_matrix(arm_[leg]), JJ = J * J.transpose(), AA = A * A.transpose();
      place_noise_[leg] = c_.joint_noise * c_.joint_noise * JJ + c_.attitude_noise * c_.attitude_noise * AA +
                          c_.leg_noise * c_.leg_noise * Mat3::Identity();
      speed_noise_[leg] = c_.joint_speed_noise * c_.joint_speed_noise * JJ + c_.gyro_noise * c_.gyro_noise * AA;
      speed_noise_[leg].diagonal() += c_.foot_speed_noise * c_.foot_speed_noise * kPeriod / dt * uneven();
      if (c_.contact_source == Source::force) load[leg] = s.foot_force[leg];
      if (c_.contact_source == Source::height) load[leg] = foot.position[2];
      if (c_.contact_source == Source::torque) {  // tau + J' f = 0
        const Mat3 Jt = foot.jacobian.transpose();
        const bool straight = std::abs(Jt.determinant()) < 1e-6;
        load[leg] = straight ? 0.0 : -(rot_ * Jt.inverse() * s.tau.segment<3>(3 * leg))[2];
      }
    }
    if (c_.contact_source == Source::height) {  // above the two lowest feet
      Vec4 sorted = load;
      std::sort(sorted.data(), sorted.data() + kLegs);
      load = (0.5 * (sorted[0] + sorted[1]) - load.array()).matrix();
    }
    const double width = c_.contact_high - c_.contact_low;
    contact_ = ((load.array() - c_.contact_low) / width).max(0.0).min(1.0).matrix();
  }

  // Variances of how a foot on the ground moves, in units of the horizontal one.
  Vec3 uneven() const { return Vec3(1.0, 1.0, c_.sinking * c_.sinking); }

  void start() {
    running_ = true;
    x_.setZero();
    P_.setZero();
    P_.block<3, 3>(3, 3).diagonal().setConstant(c_.initial_speed * c_.initial_speed);
    P_.block<3, 3>(6, 6).diagonal().setConstant(c_.initial_bias * c_.initial_bias);
    P_(kGround, kGround) = c_.level_noise * c_.level_noise;
    P_.block<2, 2>(kGround + 1, kGround + 1).diagonal().setConstant(c_.slope_walk * c_.slope_walk);
    double lowest = arm_[0][2];
    for (int leg = 1; leg < kLegs; ++leg) lowest = std::min(lowest, arm_[leg][2]);
    x_[2] = c_.foot_radius - lowest;  // the world's origin: on the ground, below the IMU
    for (int leg = 0; leg < kLegs; ++leg) anchor(leg);
    age_.setZero();
    unseen_ = 0.0;
  }

  // Sets a foot down where the legs say it is: it becomes a copy of the IMU's place, with the leg's noise.
  void anchor(int leg) {
    const int at = 9 + 3 * leg;
    x_.segment<3>(at) = x_.head<3>() + arm_[leg];
    P_.middleRows<3>(at) = P_.topRows<3>().eval();
    P_.middleCols<3>(at) = P_.leftCols<3>().eval();
    P_.block<3, 3>(at, at) = P_.topLeftCorner<3, 3>() + place_noise_[leg];
  }

  void widen_speed() {
    P_.middleRows<3>(3).setZero();
    P_.middleCols<3>(3).setZero();
    P_.block<3, 3>(3, 3).diagonal().setConstant(c_.initial_speed * c_.initial_speed);
    unseen_ = 0.0;
  }

  void predict(const Vec3& acc, double dt) {
    // A sample is the mean over kPeriod; before it the acceleration was anywhere from the last one to this one.
    const double unseen = std::max(dt - kPeriod, 0.0);
    const Vec3 force = rot_ * acc, jump = force - force_;
    const Vec3 a = force - 0.5 * unseen / dt * jump - rot_ * x_.segment<3>(6) - kGravity * Vec3::UnitZ();
    force_ = force;
    // The ground below rises by m . v dt; v's row is still the old one here.
    const Eigen::Vector2d along = dt * x_.segment<2>(3), rise = dt * x_.segment<2>(kGround + 1);
    x_[kGround] += rise.dot(x_.segment<2>(3));
    P_.row(kGround) += along.transpose() * P_.middleRows<2>(kGround + 1) + rise.transpose() * P_.middleRows<2>(3);
    P_.col(kGround) += P_.middleCols<2>(kGround + 1) * along + P_.middleCols<2>(3) * rise;
    x_.head<3>() += dt * x_.segment<3>(3) + 0.5 * dt * dt * a;
    x_.segment<3>(3) += dt * a;
    // P = F P F': r takes dt v - dt2/2 R b, v takes -dt R b
    const Mat3 V = -dt * rot_, S = 0.5 * dt * V;
    P_.topRows<3>() += (dt * P_.middleRows<3>(3) + S * P_.middleRows<3>(6)).eval();
    P_.middleRows<3>(3) += (V * P_.middleRows<3>(6)).eval();
    P_.leftCols<3>() += (dt * P_.middleCols<3>(3) + P_.middleCols<3>(6) * S.transpose()).eval();
    P_.middleCols<3>(3) += (P_.middleCols<3>(6) * V.transpose()).eval();
    const double excess = (acc.norm() - kGravity) / c_.impact_acceleration;
    const Vec3 n = (c_.acceleration_noise * c_.acceleration_noise * (1.0 + excess * excess) +
                    jump.array().square() * unseen * unseen / (12.0 * dt))
                       .matrix();
    P_.block<3, 3>(0, 0).diagonal() += n * (dt * dt * dt / 3.0);
    P_.block<3, 3>(0, 3).diagonal() += n * (dt * dt / 2.0);
    P_.block<3, 3>(3, 0).diagonal() += n * (dt * dt / 2.0);
    P_.block<3, 3>(3, 3).diagonal() += n * dt;
    P_.block<3, 3>(6, 6).diagonal().array() += c_.bias_walk * c_.bias_walk * dt;
    P_(kGround, kGround) += c_.ground_walk * c_.ground_walk * dt;
    P_.block<2, 2>(kGround + 1, kGround + 1).diagonal().array() += c_.slope_walk * c_.slope_walk * dt;
    for (int leg = 0; leg < kLegs; ++leg) {
      const double drift = c_.foot_drift / std::max(contact_[leg], c_.contact_least);
      x_.segment<3>(9 + 3 * leg) += dt * rolling_[leg];
      P_.block<3, 3>(9 + 3 * leg, 9 + 3 * leg).diagonal() += drift * drift * dt * uneven();
    }
  }

  void correct(double dt) {
    bool any = false, seen = false;
    for (int leg = 0; leg < kLegs; ++leg) age_[leg] = contact_[leg] >= c_.contact_least ? age_[leg] + dt : 0.0;
    for (int leg = 0; leg < kLegs; ++leg) {
      if (age_[leg] <= c_.settle) {  // in the air, or still landing
        anchor(leg);
        continue;
      }
      any = true;
      if (c_.level_noise > 0.0 && age_[leg] - dt <= c_.settle) level(leg);
      const bool holds = correct_speed(leg) && correct_place(leg);
      if (holds) seen = true;
      else anchor(leg);
    }
    unseen_ = !any || seen ? 0.0 : unseen_ + dt;
    if (unseen_ > c_.lost_after) widen_speed();
  }

  // A foot that has just been set down is where the ground was, give or take: this keeps the height from drifting.
  void level(int leg) {
    const int at = 9 + 3 * leg + 2;
    const Eigen::Vector2d away = x_.segment<2>(at - 2) - x_.head<2>();
    const double error = c_.foot_radius + x_[kGround] + x_.segment<2>(kGround + 1).dot(away) - x_[at];
    const State Ph = P_.col(at) - P_.col(kGround) - P_.middleCols<2>(kGround + 1) * away;
    const double S = Ph[at] - Ph[kGround] - Ph.segment<2>(kGround + 1).dot(away) + c_.level_noise * c_.level_noise;
    if (error * error > c_.gate * S) return;  // a step
    x_ += Ph * (error / S);
    P_ -= Ph * (Ph.transpose() / S);
  }

  // The contact point stands still. False if the foot slips; it then counts for less.
  bool correct_speed(int leg) {
    if (c_.foot_speed_noise <= 0.0) return true;
    const Vec3 error = rolling_[leg] - moving_[leg] - x_.segment<3>(3);
    Mat3 R = speed_noise_[leg] / (contact_[leg] * contact_[leg]);
    const double d2 = error.dot((P_.block<3, 3>(3, 3) + R).inverse() * error);
    if (d2 > c_.gate) R *= (d2 / c_.gate) * (d2 / c_.gate);  // the farther off, the less it pulls
    apply(P_.middleCols<3>(3), P_.block<3, 3>(3, 3) + R, error);
    return d2 <= c_.gate;
  }

  // The foot is where it was set down. False if it cannot be.
  bool correct_place(int leg) {
    const int at = 9 + 3 * leg;
    const Vec3 error = arm_[leg] - (x_.segment<3>(at) - x_.head<3>());
    const Gain PH = P_.middleCols<3>(at) - P_.leftCols<3>();
    const Mat3 S = PH.middleRows<3>(at) - PH.topRows<3>() + place_noise_[leg];
    if (error.dot(S.inverse() * error) > c_.gate) return false;
    apply(PH, S, error);
    return true;
  }

  using Gain = Eigen::Matrix<double, kStates, 3>;

  // Kalman's step for an innovation with covariance S; PH is P H'.
  void apply(const Gain& PH, const Mat3& S, const Vec3& error) {
    const Gain K = PH * S.inverse();
    x_ += K * error;
    P_ -= K * PH.transpose();
    P_ = (0.5 * (P_ + P_.transpose())).eval();
  }

  Settings c_;
  bool speeds_;  // whether the joints' velocities are used at all
  bool running_;
  double time_, unseen_;
  int late_;
  State x_;
  Covariance P_;
  Eigen::Quaterniond attitude_;
  Mat3 rot_;
  Vec3 gyro_, force_;
  Vec4 contact_, age_;
  std::array<Vec3, kLegs> arm_, moving_, rolling_;
  std::array<Mat3, kLegs> place_noise_, speed_noise_;
};

}  // namespace go1exp
