// SPDX-License-Identifier: BSD-3-Clause
// Ceres on pinhole images of points and lines, calibration held: ceres_points_lines FILE SOLVER THREADS
//
// The state of the art as a careful user would write it: analytic derivatives, the tangent Jacobian of every block
// written directly (the manifolds' own Jacobians are identities), lines as Pluecker vectors in the orthonormal chart.
// The file is text: counts of cameras, points, lines, point and line observations; f cx cy; per camera a rotation
// vector and a translation (cam_from_world); points; end points of lines; rows `camera point u v`; rows
// `camera line u1 v1 u2 v2`.
#include <Eigen/Dense>

#include "common.h"

using Matrix3 = Eigen::Matrix3d;
using Vector3 = Eigen::Vector3d;
template <int R, int C>
using Rows = Eigen::Matrix<double, R, C, Eigen::RowMajor>;

static double focal, center_x, center_y;

static Matrix3 Skew(const Vector3& a) {
  Matrix3 m;
  m << 0, -a[2], a[1], a[2], 0, -a[0], -a[1], a[0], 0;
  return m;
}

static Matrix3 Exp(const Vector3& w) {
  const double angle = w.norm();
  if (angle < 1e-12) return Matrix3::Identity() + Skew(w);
  return Eigen::AngleAxisd(angle, w / angle).toRotationMatrix();
}

// Both charts: the cost functions put the derivative by the increment into the first columns, zeros behind.
template <int Ambient, int Tangent>
struct Chart : ceres::Manifold {
  int AmbientSize() const override { return Ambient; }
  int TangentSize() const override { return Tangent; }
  bool PlusJacobian(const double*, double* jacobian) const override {
    Eigen::Map<Rows<Ambient, Tangent>> m(jacobian);
    m.setZero();
    m.template topRows<Tangent>().setIdentity();
    return true;
  }
  bool Minus(const double*, const double*, double*) const override { return false; }
  bool MinusJacobian(const double*, double*) const override { return false; }
};

// Rotation matrix and translation; a rotation vector from the left and a shift of the translation.
struct PoseChart : Chart<12, 6> {
  bool Plus(const double* x, const double* d, double* y) const override {
    Eigen::Map<Rows<3, 3>> turned(y);
    turned = Exp(Vector3(d[0], d[1], d[2])) * Eigen::Map<const Rows<3, 3>>(x);
    for (int i = 0; i < 3; i++) y[9 + i] = x[9 + i] + d[3 + i];
    return true;
  }
};

// Pluecker vector (moment, direction) of norm one, orthonormal chart.
struct LineChart : Chart<6, 4> {
  static Matrix3 Frame(const double* x, double& cosine, double& sine) {
    const Vector3 n(x[0], x[1], x[2]), v(x[3], x[4], x[5]);
    const double a = n.norm(), b = v.norm(), scale = std::hypot(a, b);
    Matrix3 u;
    u << n / a, v / b, (n / a).cross(v / b);
    cosine = a / scale;
    sine = b / scale;
    return u;
  }
  static Rows<6, 4> Jacobian(const double* x) {
    double c, s;
    const Matrix3 u = Frame(x, c, s);
    Rows<6, 4> j = Rows<6, 4>::Zero();
    j.block<3, 1>(0, 1) = -c * u.col(2);
    j.block<3, 1>(0, 2) = c * u.col(1);
    j.block<3, 1>(0, 3) = -s * u.col(0);
    j.block<3, 1>(3, 0) = s * u.col(2);
    j.block<3, 1>(3, 2) = -s * u.col(0);
    j.block<3, 1>(3, 3) = c * u.col(1);
    return j;
  }
  bool Plus(const double* x, const double* d, double* y) const override {
    double c, s;
    const Matrix3 u = Frame(x, c, s) * Exp(Vector3(d[0], d[1], d[2]));
    const double cd = std::cos(d[3]), sd = std::sin(d[3]);
    Eigen::Map<Vector3> moment(y), direction(y + 3);
    moment = (c * cd - s * sd) * u.col(0);
    direction = (s * cd + c * sd) * u.col(1);
    return true;
  }
};

struct PointCost : ceres::SizedCostFunction<2, 12, 3> {
  double u, v;
  PointCost(double u, double v) : u(u), v(v) {}
  bool Evaluate(double const* const* p, double* residual, double** jacobians) const override {
    Eigen::Map<const Rows<3, 3>> R(p[0]);
    const Vector3 turned = R * Eigen::Map<const Vector3>(p[1]);
    const double inverse = 1.0 / (turned[2] + p[0][11]);
    const double x = (turned[0] + p[0][9]) * inverse, y = (turned[1] + p[0][10]) * inverse;
    residual[0] = focal * x + center_x - u;
    residual[1] = focal * y + center_y - v;
    if (!jacobians) return true;
    const double a = focal * inverse, rx = turned[0], ry = turned[1], rz = turned[2];
    if (jacobians[0]) {
      const double rows[2][6] = {{-a * x * ry, a * (rz + x * rx), -a * ry, a, 0, -a * x},
                                 {-a * (rz + y * ry), a * y * rx, a * rx, 0, a, -a * y}};
      std::memset(jacobians[0], 0, 24 * sizeof(double));
      std::memcpy(jacobians[0], rows[0], sizeof rows[0]);
      std::memcpy(jacobians[0] + 12, rows[1], sizeof rows[1]);
    }
    if (jacobians[1])
      for (int k = 0; k < 3; k++) {
        jacobians[1][k] = a * (R(0, k) - x * R(2, k));
        jacobians[1][3 + k] = a * (R(1, k) - y * R(2, k));
      }
    return true;
  }
};

// Distances of the measured end points from the projected line, pixels.
struct LineCost : ceres::SizedCostFunction<2, 12, 6> {
  Vector3 end[2];
  explicit LineCost(const double* z) {
    for (int i = 0; i < 2; i++) end[i] = {(z[2 * i] - center_x) / focal, (z[2 * i + 1] - center_y) / focal, 1};
  }
  bool Evaluate(double const* const* p, double* residual, double** jacobians) const override {
    Eigen::Map<const Rows<3, 3>> R(p[0]);
    const Vector3 t = Eigen::Map<const Vector3>(p[0] + 9);
    const Vector3 moment = R * Eigen::Map<const Vector3>(p[1]), direction = R * Eigen::Map<const Vector3>(p[1] + 3);
    const Vector3 image = moment + t.cross(direction);
    const double inverse = 1.0 / std::hypot(image[0], image[1]);
    Rows<2, 3> by_image;
    for (int i = 0; i < 2; i++) {
      const double distance = image.dot(end[i]) * inverse;
      residual[i] = focal * distance;
      by_image.row(i) = focal * inverse * (end[i] - distance * inverse * Vector3(image[0], image[1], 0)).transpose();
    }
    if (!jacobians) return true;
    if (jacobians[0]) {
      Eigen::Map<Rows<2, 12>> j(jacobians[0]);
      j.setZero();
      j.block<2, 3>(0, 0) = -by_image * (Skew(moment) + Skew(t) * Skew(direction));
      j.block<2, 3>(0, 3) = -by_image * Skew(direction);
    }
    if (jacobians[1]) {
      Eigen::Map<Rows<2, 6>> j(jacobians[1]);
      Rows<2, 6> by_line;
      by_line << by_image * R, by_image * (Skew(t) * R);
      j.setZero();
      j.leftCols<4>() = by_line * LineChart::Jacobian(p[1]);
    }
    return true;
  }
};

int main(int argc, char** argv) {
  FILE* f = argc == 4 ? fopen(argv[1], "r") : nullptr;
  int nc, np, nl, mp, ml;
  if (!f || fscanf(f, "%d %d %d %d %d %lf %lf %lf", &nc, &np, &nl, &mp, &ml, &focal, &center_x, &center_y) != 8) return 2;
  std::vector<double> camera(6 * nc), point(3 * np), ends(6 * nl), pixel(2 * mp), segment(4 * ml);
  std::vector<int> camera_of(mp), point_of(mp), line_camera(ml), line_of(ml);
  for (auto* values : {&camera, &point, &ends})
    for (double& value : *values)
      if (fscanf(f, "%lf", &value) != 1) return 2;
  for (int k = 0; k < mp; k++)
    if (fscanf(f, "%d %d %lf %lf", &camera_of[k], &point_of[k], &pixel[2 * k], &pixel[2 * k + 1]) != 4) return 2;
  for (int k = 0; k < ml; k++) {
    double* z = &segment[4 * k];
    if (fscanf(f, "%d %d %lf %lf %lf %lf", &line_camera[k], &line_of[k], z, z + 1, z + 2, z + 3) != 6) return 2;
  }
  fclose(f);

  std::vector<double> pose(12 * nc), line(6 * nl);
  for (int i = 0; i < nc; i++) {
    Eigen::Map<Rows<3, 3>> rotation(pose.data() + 12 * i);
    rotation = Exp(Vector3(camera[6 * i], camera[6 * i + 1], camera[6 * i + 2]));
    std::copy_n(&camera[6 * i + 3], 3, &pose[12 * i + 9]);
  }
  for (int i = 0; i < nl; i++) {
    const Vector3 p(&ends[6 * i]), q(&ends[6 * i + 3]);
    Eigen::Map<Eigen::Matrix<double, 6, 1>> pluecker(&line[6 * i]);
    pluecker << p.cross(q), q - p;
    pluecker.normalize();
  }

  PoseChart pose_chart;
  LineChart line_chart;
  ceres::Problem::Options ownership;
  ownership.manifold_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  ceres::Problem problem(ownership);
  for (int i = 0; i < nc; i++) problem.AddParameterBlock(&pose[12 * i], 12, &pose_chart);
  for (int i = 0; i < nl; i++) problem.AddParameterBlock(&line[6 * i], 6, &line_chart);
  for (int k = 0; k < mp; k++)
    problem.AddResidualBlock(new PointCost(pixel[2 * k], pixel[2 * k + 1]), nullptr, &pose[12 * camera_of[k]],
                             &point[3 * point_of[k]]);
  for (int k = 0; k < ml; k++)
    problem.AddResidualBlock(new LineCost(&segment[4 * k]), nullptr, &pose[12 * line_camera[k]], &line[6 * line_of[k]]);
  ceres::Solver::Options options = OptionsFor(argv[2], atoi(argv[3]));
  auto* order = new ceres::ParameterBlockOrdering;
  for (int i = 0; i < np; i++) order->AddElementToGroup(&point[3 * i], 0);
  for (int i = 0; i < nl; i++) order->AddElementToGroup(&line[6 * i], 0);
  for (int i = 0; i < nc; i++) order->AddElementToGroup(&pose[12 * i], 1);
  options.linear_solver_ordering.reset(order);
  return SolveAndReport(argv[2], options, problem);
}
