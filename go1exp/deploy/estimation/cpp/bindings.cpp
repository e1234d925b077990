// The filter for Python: go1exp.deploy.estimation._kalman. Shapes are checked here, values in Filter::update.
#include <pybind11/eigen.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "kalman.hpp"

namespace py = pybind11;
using namespace go1exp;

namespace {

constexpr int kWidth = 1 + 4 + 3 + 3 + 3 * kJoints + kLegs;  // numbers in a sample, in the order of Sample
constexpr int kOutput = 3 + 3 + kLegs + 1;  // position_w, velocity_b, contact, status

using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Row = Eigen::Matrix<double, kWidth, 1>;

Sample to_sample(const double* v) {
  const Eigen::Map<const Row> row(v);
  Sample s;
  s.t = row[0];
  s.quat = row.segment<4>(1);
  s.gyro = row.segment<3>(5);
  s.acc = row.segment<3>(8);
  s.q = row.segment<kJoints>(11);
  s.qd = row.segment<kJoints>(11 + kJoints);
  s.tau = row.segment<kJoints>(11 + 2 * kJoints);
  s.foot_force = row.segment<kLegs>(11 + 3 * kJoints);
  return s;
}

Leg chain(const Vec3& hip, const Vec3& lengths) {
  Leg leg;
  leg.polynomial = false;
  leg.chain = {hip, lengths};
  leg.curve = {Vec3::Zero(), Vec3::Ones(), Eigen::Matrix<double, 3, Polynomial::kTerms>::Zero()};
  return leg;
}

Leg polynomial(const Vec3& centre, const Vec3& scale, const Eigen::Matrix<double, 3, Polynomial::kTerms>& coefficients) {
  Leg leg = chain(Vec3::Zero(), Vec3::Zero());
  leg.polynomial = true;
  leg.curve = {centre, scale, coefficients};
  return leg;
}

// Takes a sample; a sanitised build aborts if that allocates.
Status update(Filter& filter, const double* row) {
#ifdef EIGEN_RUNTIME_NO_MALLOC
  Eigen::internal::set_is_malloc_allowed(false);
#endif
  const Status status = filter.update(to_sample(row));
#ifdef EIGEN_RUNTIME_NO_MALLOC
  Eigen::internal::set_is_malloc_allowed(true);
#endif
  return status;
}

// Many samples at once, for logs: (T, kWidth) -> (T, kOutput).
Rows run(Filter& filter, const Eigen::Ref<const Rows>& samples) {
  if (samples.cols() != kWidth) throw py::value_error("samples: must have " + std::to_string(kWidth) + " columns");
  Rows found(samples.rows(), kOutput);
  for (Eigen::Index i = 0; i < samples.rows(); ++i) {
    const Row row = samples.row(i);
    const Status status = update(filter, row.data());
    found.row(i) << filter.position_w().transpose(), filter.velocity_b().transpose(), filter.contact().transpose(),
        static_cast<double>(status);
  }
  return found;
}

}  // namespace

PYBIND11_MODULE(_kalman, m) {
  m.doc() = "The Kalman filter of go1exp.deploy.estimation, in C++.";
  m.attr("SAMPLE_WIDTH") = kWidth;

  py::class_<Leg>(m, "Leg")
      .def_static("chain", &chain, py::arg("hip"), py::arg("lengths"))
      .def_static("polynomial", &polynomial, py::arg("centre"), py::arg("scale"), py::arg("coefficients"))
      .def(
          "foot",
          [](const Leg& leg, const Vec3& q) {
            const Foot foot = leg.at(q);
            return py::make_tuple(foot.position, foot.jacobian, foot.turning);
          },
          py::arg("q"), "Position (3,), m; Jacobian (3, 3), m/rad; turning (3, 3).");

  py::class_<Settings>(m, "Settings")
      .def(py::init<>())
      .def_readwrite("legs", &Settings::legs)
      .def_readwrite("imu_position", &Settings::imu_position)
      .def_readwrite("foot_radius", &Settings::foot_radius)
      .def_property(
          "contact_source", [](const Settings& s) { return static_cast<int>(s.contact_source); },
          [](Settings& s, int source) { s.contact_source = static_cast<Source>(source); })
      .def_readwrite("contact_low", &Settings::contact_low)
      .def_readwrite("contact_high", &Settings::contact_high)
      .def_readwrite("contact_least", &Settings::contact_least)
      .def_readwrite("settle", &Settings::settle)
      .def_readwrite("acceleration_noise", &Settings::acceleration_noise)
      .def_readwrite("impact_acceleration", &Settings::impact_acceleration)
      .def_readwrite("bias_walk", &Settings::bias_walk)
      .def_readwrite("attitude_time", &Settings::attitude_time)
      .def_readwrite("attitude_noise", &Settings::attitude_noise)
      .def_readwrite("gyro_noise", &Settings::gyro_noise)
      .def_readwrite("joint_noise", &Settings::joint_noise)
      .def_readwrite("joint_speed_noise", &Settings::joint_speed_noise)
      .def_readwrite("leg_noise", &Settings::leg_noise)
      .def_readwrite("foot_drift", &Settings::foot_drift)
      .def_readwrite("foot_speed_noise", &Settings::foot_speed_noise)
      .def_readwrite("sinking", &Settings::sinking)
      .def_readwrite("level_noise", &Settings::level_noise)
      .def_readwrite("ground_walk", &Settings::ground_walk)
      .def_readwrite("slope_walk", &Settings::slope_walk)
      .def_readwrite("initial_speed", &Settings::initial_speed)
      .def_readwrite("initial_bias", &Settings::initial_bias)
      .def_readwrite("gate", &Settings::gate)
      .def_readwrite("longest_gap", &Settings::longest_gap)
      .def_readwrite("lost_after", &Settings::lost_after);

  py::class_<Filter>(m, "Filter")
      .def(py::init<const Settings&>(), py::arg("settings"))
      .def("reset", &Filter::reset)
      .def(
          "update",
          [](Filter& filter, const Eigen::Ref<const Row>& sample) {
            return static_cast<int>(update(filter, sample.data()));
          },
          py::arg("sample"), "Take one sample (SAMPLE_WIDTH,); return its Status as a number.")
      .def("run", &run, py::arg("samples"), "Take samples (T, SAMPLE_WIDTH); return what is known after each, (T, 11).")
      .def_property_readonly("running", &Filter::running)
      .def_property_readonly("time", &Filter::time)
      .def_property_readonly("velocity_w", &Filter::velocity_w)
      .def_property_readonly("velocity_b", &Filter::velocity_b)
      .def_property_readonly("position_w", &Filter::position_w)
      .def_property_readonly("contact", [](const Filter& f) { return Vec4(f.contact()); })
      .def_property_readonly("state", [](const Filter& f) { return State(f.state()); })
      .def_property_readonly("covariance", [](const Filter& f) { return Covariance(f.covariance()); });
}
