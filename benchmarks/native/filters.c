/* What the machine can do: batched Kalman filters by hand, for the systems of benchmarks/systems.py.
 *
 * A block is as many runs as there are lanes in V; it stays in cache for all of its rows. Jacobians by hand, covariances
 * as packed lower triangles, sensors one after the other (R is diagonal), every zero of the models used; "dense" uses
 * none of them. Threads take blocks in turn.
 *
 * In blocks, with L lanes innermost: z [block][T][m][L], x0 [block][n][L], P0 [block][n (n + 1) / 2][L], means and
 * variances [block][T][n][L]. As ordinary arrays: z [N][T][m], means and variances [N][T][n].
 */
#include <math.h>
#include <stddef.h>
#include <string.h>
#ifdef _OPENMP
#include <omp.h>
#endif

#include "vector.h"
#define L ((int)(BYTES / sizeof(REAL)))
#define UNROLL _Pragma("GCC unroll 16")
#define ID(i, j) ((i) >= (j) ? (i) * ((i) + 1) / 2 + (j) : (j) * ((j) + 1) / 2 + (i))

typedef struct {
    int steps;
    const REAL *z, *x0, *P0, *u, *Q, *R, *F, *H, *weights; /* Q, R, F, H in full */
    REAL *means, *variances;
} Args;

INLINE V all(REAL a)
{
    V v;
    for (int l = 0; l < L; l++) v[l] = a;
    return v;
}

INLINE V load(const REAL *from)
{
    V v;
    memcpy(&v, from, sizeof v);
    return v;
}

/* loops that gcc turns into vector calls under -ffast-math */
INLINE V lane_sin(V x)
{
    REAL a[L], b[L];
    memcpy(a, &x, sizeof x);
    for (int l = 0; l < L; l++) b[l] = sizeof(REAL) == 8 ? sin(a[l]) : sinf(a[l]);
    return load(b);
}

INLINE V lane_cos(V x)
{
    REAL a[L], b[L];
    memcpy(a, &x, sizeof x);
    for (int l = 0; l < L; l++) b[l] = sizeof(REAL) == 8 ? cos(a[l]) : cosf(a[l]);
    return load(b);
}

INLINE V lane_sqrt(V x)
{
    REAL a[L];
    memcpy(a, &x, sizeof x);
    for (int l = 0; l < L; l++) a[l] = sizeof(REAL) == 8 ? sqrt(a[l]) : sqrtf(a[l]);
    return load(a);
}

/* ---------------------------------------------------------------- pieces */

/* x and packed P after one reading y of state s with variance r */
INLINE void update_one(const int n, const int s, V *x, V *P, REAL r, V y)
{
    V g[12], k[12], inverse = 1 / (P[ID(s, s)] + r), e = y - x[s];
    UNROLL for (int i = 0; i < n; i++) {
        g[i] = P[ID(i, s)];
        k[i] = g[i] * inverse;
        x[i] += k[i] * e;
    }
    UNROLL for (int i = 0; i < n; i++)
        UNROLL for (int j = 0; j <= i; j++) P[ID(i, j)] -= k[i] * g[j];
}

/* P <- F P F' + Q, all of them full */
INLINE void predict_dense(const int n, V *P, const V *F, const REAL *Q)
{
    V A[12 * 12];
    for (int i = 0; i < n; i++) {
        V sum[12];
        UNROLL for (int j = 0; j < n; j++) sum[j] = F[i * n] * P[j];
        for (int k = 1; k < n; k++)
            UNROLL for (int j = 0; j < n; j++) sum[j] += F[i * n + k] * P[k * n + j];
        UNROLL for (int j = 0; j < n; j++) A[i * n + j] = sum[j];
    }
    for (int i = 0; i < n; i++) {
        V sum[12];
        UNROLL for (int j = 0; j < n; j++) sum[j] = all(Q[i * n + j]);
        for (int k = 0; k < n; k++)
            UNROLL for (int j = 0; j < n; j++) if (j <= i) sum[j] += A[i * n + k] * F[j * n + k];
        UNROLL for (int j = 0; j < n; j++) if (j <= i) P[i * n + j] = P[j * n + i] = sum[j];
    }
}

/* S = M D M' of packed S (m), M below the diagonal, D on it; 1 / D apart */
INLINE void factor(const int m, V *S, V *inverse)
{
    UNROLL for (int j = 0; j < m; j++) {
        UNROLL for (int k = 0; k < j; k++) S[ID(j, j)] -= S[ID(j, k)] * S[ID(j, k)] * S[ID(k, k)];
        inverse[j] = 1 / S[ID(j, j)];
        UNROLL for (int i = j + 1; i < m; i++) {
            UNROLL for (int k = 0; k < j; k++) S[ID(i, j)] -= S[ID(i, k)] * S[ID(j, k)] * S[ID(k, k)];
            S[ID(i, j)] *= inverse[j];
        }
    }
}

/* y = M^-1 y */
INLINE void forward(const int m, const V *S, V *y)
{
    UNROLL for (int i = 1; i < m; i++)
        UNROLL for (int k = 0; k < i; k++) y[i] -= S[ID(i, k)] * y[k];
}

/* x and full P after readings with residual r, a constant full H and a full R */
INLINE void update_dense(const int n, const int m, V *x, V *P, const REAL *H, const REAL *R, V *r)
{
    V W[9 * 12], S[9 * 10 / 2], inverse[9];
    for (int a = 0; a < m; a++)
        for (int j = 0; j < n; j++) {
            V sum = H[a * n] * P[j];
            UNROLL for (int k = 1; k < n; k++) sum += H[a * n + k] * P[k * n + j];
            W[j * m + a] = sum;
        }
    for (int a = 0; a < m; a++)
        for (int b = 0; b <= a; b++) {
            V sum = all(R[a * m + b]);
            UNROLL for (int k = 0; k < n; k++) sum += W[k * m + a] * H[b * n + k];
            S[ID(a, b)] = sum;
        }
    factor(m, S, inverse);
    forward(m, S, r);
    for (int i = 0; i < n; i++) forward(m, S, W + i * m);
    for (int i = 0; i < n; i++) {
        UNROLL for (int a = 0; a < m; a++) x[i] += W[i * m + a] * inverse[a] * r[a];
        for (int j = 0; j <= i; j++) {
            V sum = P[i * n + j];
            UNROLL for (int a = 0; a < m; a++) sum -= W[i * m + a] * inverse[a] * W[j * m + a];
            P[i * n + j] = P[j * n + i] = sum;
        }
    }
}

INLINE void unpacked(const int n, const REAL *P0, V *P)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) P[i * n + j] = P[j * n + i] = load(P0 + (size_t)ID(i, j) * L);
}

#define BEGIN(N_, M_)                                                                     \
    enum { n = N_, m = M_ };                                                              \
    const REAL *z = g->z + (size_t)b * g->steps * m * L;                                  \
    const REAL *P0 = g->P0 + (size_t)b * n * (n + 1) / 2 * L;                             \
    REAL *mean = g->means + (size_t)b * g->steps * n * L;                                 \
    REAL *variance = g->variances + (size_t)b * g->steps * n * L;                         \
    V x[n];                                                                               \
    memcpy(x, g->x0 + (size_t)b * n * L, sizeof x)

#define Z(i) load(z + (i) * L)

#define STORE(diagonal)                                                                   \
    do {                                                                                  \
        UNROLL for (int i = 0; i < n; i++) {                                              \
            memcpy(mean + i * L, &x[i], BYTES);                                           \
            memcpy(variance + i * L, &P[diagonal], BYTES);                                \
        }                                                                                 \
        mean += n * L, variance += n * L, z += m * L;                                     \
    } while (0)

/* ---------------------------------------------------------------- the target in the plane */

static void target(const Args *g, int b)
{
    BEGIN(4, 2);
    V P[10];
    memcpy(P, P0, sizeof P);
    const REAL dt = g->F[1], *Q = g->Q;
    for (int t = 0; t < g->steps; t++) {
        x[0] += dt * x[1];
        x[2] += dt * x[3];
        V a = P[ID(1, 0)] + dt * P[ID(1, 1)], c = P[ID(3, 2)] + dt * P[ID(3, 3)];
        V d = P[ID(2, 1)] + dt * P[ID(3, 1)], e = P[ID(3, 0)] + dt * P[ID(3, 1)];
        P[ID(0, 0)] += dt * (P[ID(1, 0)] + a) + Q[0];
        P[ID(2, 0)] += dt * (P[ID(2, 1)] + e);
        P[ID(2, 2)] += dt * (P[ID(3, 2)] + c) + Q[10];
        P[ID(1, 0)] = a + Q[4], P[ID(3, 2)] = c + Q[14], P[ID(2, 1)] = d, P[ID(3, 0)] = e;
        P[ID(1, 1)] += Q[5], P[ID(3, 3)] += Q[15];
        update_one(n, 0, x, P, g->R[0], Z(0));
        update_one(n, 2, x, P, g->R[3], Z(1));
        STORE(ID(i, i));
    }
}

static void target_dense(const Args *g, int b)
{
    BEGIN(4, 2);
    V P[16], F[16];
    unpacked(n, P0, P);
    for (int i = 0; i < 16; i++) F[i] = all(g->F[i]);
    for (int t = 0; t < g->steps; t++) {
        V moved[4], r[2];
        for (int i = 0; i < 4; i++) {
            moved[i] = F[i * 4] * x[0];
            UNROLL for (int k = 1; k < 4; k++) moved[i] += F[i * 4 + k] * x[k];
        }
        memcpy(x, moved, sizeof x);
        predict_dense(n, P, F, g->Q);
        for (int a = 0; a < 2; a++) {
            r[a] = Z(a);
            UNROLL for (int k = 0; k < 4; k++) r[a] -= g->H[a * 4 + k] * x[k];
        }
        update_dense(n, m, x, P, g->H, g->R, r);
        STORE(i * n + i);
    }
}

/* ---------------------------------------------------------------- the car */

#define CAR_DT ((REAL)0.02)

/* moves x; F: d(px, py) / d(heading, speed) */
INLINE void car_moved(V *x, V *F, const REAL *u)
{
    const REAL dt = CAR_DT;
    V s = dt * lane_sin(x[2]), c = dt * lane_cos(x[2]);
    F[0] = -x[3] * s, F[1] = c, F[2] = x[3] * c, F[3] = s;
    x[0] += x[3] * c, x[1] += x[3] * s, x[2] += dt * x[4], x[3] += dt * u[0], x[4] += dt * u[1];
}

static void car(const Args *g, int b)
{
    BEGIN(5, 3);
    const REAL dt = CAR_DT;
    V P[15], f[4], A[3][5];
    memcpy(P, P0, sizeof P);
    for (int t = 0; t < g->steps; t++) {
        car_moved(x, f, g->u + 2 * t);
        UNROLL for (int j = 0; j < 5; j++) {
            A[0][j] = P[ID(0, j)] + f[0] * P[ID(2, j)] + f[1] * P[ID(3, j)];
            A[1][j] = P[ID(1, j)] + f[2] * P[ID(2, j)] + f[3] * P[ID(3, j)];
            A[2][j] = P[ID(2, j)] + dt * P[ID(4, j)];
        }
        UNROLL for (int i = 0; i < 3; i++) P[ID(3, i)] = A[i][3], P[ID(4, i)] = A[i][4];
        P[ID(0, 0)] = A[0][0] + f[0] * A[0][2] + f[1] * A[0][3] + g->Q[0];
        P[ID(1, 0)] = A[1][0] + f[0] * A[1][2] + f[1] * A[1][3];
        P[ID(1, 1)] = A[1][1] + f[2] * A[1][2] + f[3] * A[1][3] + g->Q[6];
        P[ID(2, 0)] = A[2][0] + f[0] * A[2][2] + f[1] * A[2][3];
        P[ID(2, 1)] = A[2][1] + f[2] * A[2][2] + f[3] * A[2][3];
        P[ID(2, 2)] = A[2][2] + dt * A[2][4] + g->Q[12];
        P[ID(3, 3)] += g->Q[18], P[ID(4, 4)] += g->Q[24];
        update_one(n, 0, x, P, g->R[0], Z(0));
        update_one(n, 1, x, P, g->R[4], Z(1));
        update_one(n, 3, x, P, g->R[8], Z(2));
        STORE(ID(i, i));
    }
}

static void car_dense(const Args *g, int b)
{
    BEGIN(5, 3);
    V P[25], F[25], f[4];
    unpacked(n, P0, P);
    for (int i = 0; i < 25; i++) F[i] = all(i % 6 == 0 ? 1 : 0);
    F[2 * 5 + 4] = all(CAR_DT);
    for (int t = 0; t < g->steps; t++) {
        car_moved(x, f, g->u + 2 * t);
        F[2] = f[0], F[3] = f[1], F[7] = f[2], F[8] = f[3];
        predict_dense(n, P, F, g->Q);
        V r[3] = {Z(0) - x[0], Z(1) - x[1], Z(2) - x[3]};
        update_dense(n, m, x, P, g->H, g->R, r);
        STORE(i * n + i);
    }
}

/* sigma points x +- the columns of the factor of packed P, times the reach */
INLINE void points(const int n, V (*X)[5], const V *x, const V *P, REAL reach)
{
    V C[15];
    UNROLL for (int j = 0; j < n; j++) {
        V d = P[ID(j, j)];
        UNROLL for (int k = 0; k < j; k++) d -= C[ID(j, k)] * C[ID(j, k)];
        C[ID(j, j)] = lane_sqrt(d);
        V inverse = 1 / C[ID(j, j)];
        UNROLL for (int i = j + 1; i < n; i++) {
            C[ID(i, j)] = P[ID(i, j)];
            UNROLL for (int k = 0; k < j; k++) C[ID(i, j)] -= C[ID(i, k)] * C[ID(j, k)];
            C[ID(i, j)] *= inverse;
        }
    }
    UNROLL for (int i = 0; i < n; i++) {
        X[0][i] = x[i];
        UNROLL for (int j = 0; j < n; j++) {
            V d = i >= j ? reach * C[ID(i, j)] : all(0);
            X[1 + j][i] = x[i] + d, X[1 + n + j][i] = x[i] - d;
        }
    }
}

/* weights: reach, of the mean: centre, others, of the covariance: centre */
static void car_unscented(const Args *g, int b)
{
    BEGIN(5, 3);
    enum { k = 2 * n + 1 };
    static const int seen[] = {0, 1, 3};
    const REAL reach = g->weights[0], centre = g->weights[1], w = g->weights[2], wc = g->weights[3];
    V P[15], X[k][5], unused[4];
    memcpy(P, P0, sizeof P);
    for (int t = 0; t < g->steps; t++) {
        points(n, X, x, P, reach);
        for (int s = 0; s < k; s++) car_moved(X[s], unused, g->u + 2 * t);
        UNROLL for (int i = 0; i < n; i++) {
            V sum = X[1][i];
            UNROLL for (int s = 2; s < k; s++) sum += X[s][i];
            x[i] = centre * X[0][i] + w * sum;
            UNROLL for (int s = 0; s < k; s++) X[s][i] -= x[i];
        }
        UNROLL for (int i = 0; i < n; i++)
            UNROLL for (int j = 0; j <= i; j++) {
                V sum = X[1][i] * X[1][j];
                UNROLL for (int s = 2; s < k; s++) sum += X[s][i] * X[s][j];
                P[ID(i, j)] = g->Q[i * n + j] + wc * X[0][i] * X[0][j] + w * sum;
            }
        points(n, X, x, P, reach);
        V Y[k][3], y[3], S[6], inverse[3], C[5][3];
        UNROLL for (int a = 0; a < m; a++) {
            V sum = X[1][seen[a]];
            UNROLL for (int s = 2; s < k; s++) sum += X[s][seen[a]];
            y[a] = centre * X[0][seen[a]] + w * sum;
            UNROLL for (int s = 0; s < k; s++) Y[s][a] = X[s][seen[a]] - y[a];
            y[a] = Z(a) - y[a];
        }
        UNROLL for (int a = 0; a < m; a++) {
            UNROLL for (int c = 0; c <= a; c++) {
                V sum = Y[1][a] * Y[1][c];
                UNROLL for (int s = 2; s < k; s++) sum += Y[s][a] * Y[s][c];
                S[ID(a, c)] = g->R[a * m + c] + wc * Y[0][a] * Y[0][c] + w * sum;
            }
            UNROLL for (int i = 0; i < n; i++) {
                V sum = (X[1][i] - x[i]) * Y[1][a];
                UNROLL for (int s = 2; s < k; s++) sum += (X[s][i] - x[i]) * Y[s][a];
                C[i][a] = wc * (X[0][i] - x[i]) * Y[0][a] + w * sum;
            }
        }
        factor(m, S, inverse);
        forward(m, S, y);
        UNROLL for (int i = 0; i < n; i++) {
            forward(m, S, C[i]);
            UNROLL for (int a = 0; a < m; a++) x[i] += C[i][a] * inverse[a] * y[a];
            UNROLL for (int j = 0; j <= i; j++)
                UNROLL for (int a = 0; a < m; a++) P[ID(i, j)] -= C[i][a] * inverse[a] * C[j][a];
        }
        STORE(ID(i, i));
    }
}

#include "quadrotor.h"

/* ---------------------------------------------------------------- drivers */

typedef void (*Filter)(const Args *, int);

/* [system][0: by structure, 1: dense, 2: unscented] */
static const Filter FILTERS[3][3] = {
    {target, target_dense, NULL},
    {car, car_dense, car_unscented},
    {quadrotor, quadrotor_dense, NULL},
};

int lanes(void) { return L; }

void run_blocks(int system, int kind, int blocks, int threads, const Args *args)
{
    Filter filter = FILTERS[system][kind];
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (int b = 0; b < blocks; b++) filter(args, b);
}

/* Ordinary arrays: each block goes through a buffer, T (m + 2 n) L numbers for each thread. */
void run_arrays(int system, int kind, int runs, int threads, int n, int m, const Args *args, REAL *buffers)
{
    Filter filter = FILTERS[system][kind];
    const size_t T = (size_t)args->steps, packed = (size_t)n * (n + 1) / 2;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (int b = 0; b < (runs + L - 1) / L; b++) {
        REAL *z = buffers;
#ifdef _OPENMP
        z += (size_t)omp_get_thread_num() * T * (m + 2 * n) * L;
#endif
        REAL *means = z + T * m * L, *variances = means + T * n * L;
        for (int l = 0; l < L; l++) {
            const REAL *from = args->z + (b * L + l < runs ? b * L + l : runs - 1) * T * m;
            for (size_t i = 0; i < T * m; i++) z[i * L + l] = from[i];
        }
        Args one = *args;
        one.z = z, one.means = means, one.variances = variances;
        one.x0 += (size_t)b * n * L, one.P0 += (size_t)b * packed * L;
        filter(&one, 0);
        for (int l = 0; l < L && b * L + l < runs; l++) {
            size_t to = (b * L + l) * T * n;
            for (size_t i = 0; i < T * n; i++) {
                args->means[to + i] = means[i * L + l];
                args->variances[to + i] = variances[i * L + l];
            }
        }
    }
}
