/* What the machine can do for the value and the gradient of the car's EKF (benchmarks/systems.py): all eight derivatives
 * carried along with every number (forward mode), one block of runs after the other, threads over blocks. The parameters
 * are the logarithms of the diagonals of Q (5) and R (3), the loss the sum of the squared errors of the means. */
#include <cmath>
#include <cstring>

#include "vector.h"

constexpr int L = BYTES / sizeof(REAL), K = 8;
#define EACH for (int k = 0; k < K; k++)

struct Dual { V v, d[K]; };

INLINE V all(REAL a) { V v; for (int l = 0; l < L; l++) v[l] = a; return v; }
INLINE V load(const REAL *from) { V v; std::memcpy(&v, from, sizeof v); return v; }
INLINE Dual constant(V a) { Dual r; r.v = a; EACH r.d[k] = all(0); return r; }
INLINE Dual operator+(const Dual &a, const Dual &b) { Dual r; r.v = a.v + b.v; EACH r.d[k] = a.d[k] + b.d[k]; return r; }
INLINE Dual operator-(const Dual &a, const Dual &b) { Dual r; r.v = a.v - b.v; EACH r.d[k] = a.d[k] - b.d[k]; return r; }
INLINE Dual operator*(const Dual &a, const Dual &b)
{
    Dual r;
    r.v = a.v * b.v;
    EACH r.d[k] = a.d[k] * b.v + a.v * b.d[k];
    return r;
}
INLINE Dual operator*(REAL s, const Dual &a) { Dual r; r.v = s * a.v; EACH r.d[k] = s * a.d[k]; return r; }
INLINE Dual inverse(const Dual &a)
{
    Dual r;
    r.v = 1 / a.v;
    V slope = -r.v * r.v;
    EACH r.d[k] = slope * a.d[k];
    return r;
}
INLINE void sin_cos(const Dual &a, Dual &s, Dual &c)
{
    REAL in[L], out[L];
    std::memcpy(in, &a.v, sizeof in);
    for (int l = 0; l < L; l++) out[l] = std::sin(in[l]);
    s.v = load(out);
    for (int l = 0; l < L; l++) out[l] = std::cos(in[l]);
    c.v = load(out);
    EACH { s.d[k] = c.v * a.d[k]; c.d[k] = -s.v * a.d[k]; }
}

constexpr int id(int i, int j) { return i >= j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i; }

INLINE void update_one(int s, Dual *x, Dual *P, const Dual &r, V z)
{
    Dual g[5], i = inverse(P[id(s, s)] + r), e = (constant(z) - x[s]) * i;
    for (int a = 0; a < 5; a++) { g[a] = P[id(a, s)]; x[a] = x[a] + g[a] * e; }
    for (int a = 0; a < 5; a++) {
        Dual gain = g[a] * i;
        for (int b = 0; b <= a; b++) P[id(a, b)] = P[id(a, b)] - gain * g[b];
    }
}

/* z [T][3][L], truth [T][5][L], x0 [5][L], P0 [15][L]; adds the first `live` lanes to out[0 ... 8] */
static void block(int steps, int live, const REAL *z, const REAL *truth, const REAL *x0, const REAL *P0, const REAL *u,
                  const REAL *theta, double *out)
{
    const REAL dt = (REAL)0.02;
    const int seen[] = {0, 1, 3};
    Dual x[5], P[15], noise[8], loss = constant(all(0));
    for (int i = 0; i < 8; i++) { noise[i] = constant(all(std::exp(theta[i]))); noise[i].d[i] = noise[i].v; }
    for (int i = 0; i < 5; i++) x[i] = constant(load(x0 + i * L));
    for (int i = 0; i < 15; i++) P[i] = constant(load(P0 + i * L));
    for (int t = 0; t < steps; t++, z += 3 * L, truth += 5 * L, u += 2) {
        Dual s, c, A[3][5];
        sin_cos(x[2], s, c);
        Dual f1 = dt * c, f3 = dt * s, f2 = x[3] * f1, f0 = (REAL)-1 * (x[3] * f3);
        x[0] = x[0] + f2; x[1] = x[1] - f0; x[2] = x[2] + dt * x[4]; x[3].v += dt * u[0]; x[4].v += dt * u[1];
        for (int j = 0; j < 5; j++) {
            A[0][j] = P[id(0, j)] + f0 * P[id(2, j)] + f1 * P[id(3, j)];
            A[1][j] = P[id(1, j)] + f2 * P[id(2, j)] + f3 * P[id(3, j)];
            A[2][j] = P[id(2, j)] + dt * P[id(4, j)];
        }
        for (int i = 0; i < 3; i++) { P[id(3, i)] = A[i][3]; P[id(4, i)] = A[i][4]; }
        P[id(0, 0)] = A[0][0] + f0 * A[0][2] + f1 * A[0][3];
        P[id(1, 0)] = A[1][0] + f0 * A[1][2] + f1 * A[1][3];
        P[id(1, 1)] = A[1][1] + f2 * A[1][2] + f3 * A[1][3];
        P[id(2, 0)] = A[2][0] + f0 * A[2][2] + f1 * A[2][3];
        P[id(2, 1)] = A[2][1] + f2 * A[2][2] + f3 * A[2][3];
        P[id(2, 2)] = A[2][2] + dt * A[2][4];
        for (int i = 0; i < 5; i++) P[id(i, i)] = P[id(i, i)] + noise[i];
        for (int a = 0; a < 3; a++) update_one(seen[a], x, P, noise[5 + a], load(z + a * L));
        for (int i = 0; i < 5; i++) {
            V e = x[i].v - load(truth + i * L);
            loss.v += e * e;
            EACH loss.d[k] += 2 * e * x[i].d[k];
        }
    }
    for (int l = 0; l < live; l++) {
        out[0] += loss.v[l];
        EACH out[1 + k] += loss.d[k][l];
    }
}

extern "C" int lanes(void) { return L; }

/* out [blocks][9] */
extern "C" void value_and_gradient(int runs, int steps, int threads, const REAL *z, const REAL *truth, const REAL *x0,
                                   const REAL *P0, const REAL *u, const REAL *theta, double *out)
{
    const int blocks = (runs + L - 1) / L;
    const size_t T = steps;
    std::memset(out, 0, sizeof(double) * 9 * blocks);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (int b = 0; b < blocks; b++)
        block(steps, runs - b * L < L ? runs - b * L : L, z + b * T * 3 * L, truth + b * T * 5 * L, x0 + (size_t)b * 5 * L,
              P0 + (size_t)b * 15 * L, u, theta, out + 9 * b);
}
