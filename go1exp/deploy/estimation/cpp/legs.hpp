// Where a foot is in the trunk's frame, and how that moves with the joints of its leg.
//
// SI units; trunk frame x forward, y left, z up. A leg has three joints.
#pragma once

#include <Eigen/Dense>
#include <array>
#include <cmath>

namespace go1exp {

using Vec3 = Eigen::Vector3d;
using Mat3 = Eigen::Matrix3d;

// A foot at some joint angles q.
struct Foot {
  Vec3 position;  // m
  Mat3 jacobian;  // m/rad, d position / d q
  Mat3 turning;   // 1, angular velocity of the foot's link against the trunk = turning * dq/dt
};

// Hip about x, then thigh and calf about y: at q = 0 the leg points straight down.
struct Chain {
  Vec3 hip;      // m, where the hip's axis meets the thigh's plane
  Vec3 lengths;  // m: sideways to the thigh (+ left), thigh, calf

  Foot at(const Vec3& q) const {
    const double sa = std::sin(q[0]), ca = std::cos(q[0]);
    const double sb = std::sin(q[1]), cb = std::cos(q[1]);
    const double sc = std::sin(q[1] + q[2]), cc = std::cos(q[1] + q[2]);
    const double w = lengths[0];
    const double x = -lengths[1] * sb - lengths[2] * sc;
    const double h = -lengths[1] * cb - lengths[2] * cc;
    const double dh = -x;                  // dh / d thigh
    const double dh_calf = lengths[2] * sc;  // dh / d calf
    Foot foot;
    foot.position = hip + Vec3(x, w * ca - h * sa, w * sa + h * ca);
    foot.jacobian.col(0) = Vec3(0.0, -w * sa - h * ca, w * ca - h * sa);
    foot.jacobian.col(1) = Vec3(h, -dh * sa, dh * ca);
    foot.jacobian.col(2) = Vec3(-lengths[2] * cc, -dh_calf * sa, dh_calf * ca);
    foot.turning.col(0) = Vec3::UnitX();
    foot.turning.col(1) = Vec3(0.0, ca, sa);
    foot.turning.col(2) = foot.turning.col(1);
    return foot;
  }
};

// Any mechanism, by a polynomial of degree four in u = (q - centre) / scale, as it was calibrated.
// How its last link turns is not known: such a foot does not roll.
struct Polynomial {
  static constexpr int kDegree = 4;
  static constexpr int kTerms = 35;  // u0^i u1^j u2^k with i + j + k <= 4; i slowest, k fastest

  Vec3 centre;                                   // rad
  Vec3 scale;                                    // rad
  Eigen::Matrix<double, 3, kTerms> coefficients;  // m

  Foot at(const Vec3& q) const {
    const Vec3 u = (q - centre).cwiseQuotient(scale);
    Eigen::Matrix<double, 3, kDegree + 1> power;
    power.col(0).setOnes();
    for (int k = 1; k <= kDegree; ++k) power.col(k) = power.col(k - 1).cwiseProduct(u);
    Foot foot{Vec3::Zero(), Mat3::Zero(), Mat3::Zero()};
    int term = 0;
    for (int i = 0; i <= kDegree; ++i) {
      for (int j = 0; i + j <= kDegree; ++j) {
        for (int k = 0; i + j + k <= kDegree; ++k, ++term) {
          const double a = power(0, i), b = power(1, j), c = power(2, k);
          const Vec3 slope((i ? i * power(0, i - 1) : 0.0) * b * c, (j ? j * power(1, j - 1) : 0.0) * a * c,
                           (k ? k * power(2, k - 1) : 0.0) * a * b);
          foot.position += a * b * c * coefficients.col(term);
          foot.jacobian += coefficients.col(term) * slope.cwiseQuotient(scale).transpose();
        }
      }
    }
    return foot;
  }
};

// One or the other, without a heap and without virtual calls.
struct Leg {
  bool polynomial = false;
  Chain chain;
  Polynomial curve;

  Foot at(const Vec3& q) const { return polynomial ? curve.at(q) : chain.at(q); }
};

}  // namespace go1exp
