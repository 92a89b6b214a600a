/* Shape matching in plain C, as a bound on its speed: cluster fits and averaged goals of Eqs. 8, 9 and 7, particle by
   particle, without contacts. Lengths in mm. */
#include <math.h>

typedef float vec[3];

/* R <- R after one step of Newton's method for the maximum of tr(R^T M), row-major (Kugelstadt 2018). */
static void turn(float *R, const float *M) {
    float S[9], T[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) S[3 * i + j] = R[i] * M[j] + R[3 + i] * M[3 + j] + R[6 + i] * M[6 + j];
    float size = S[0] + S[4] + S[8];
    float a = size - S[0], b = size - S[4], c = size - S[8];
    float d = -(S[1] + S[3]) / 2, e = -(S[2] + S[6]) / 2, f = -(S[5] + S[7]) / 2;
    float gx = S[7] - S[5], gy = S[2] - S[6], gz = S[3] - S[1];
    float A = b * c - f * f, B = e * f - d * c, C = d * f - e * b;
    float by = 0.5f / (a * A + d * B + e * C);
    float x = by * (A * gx + B * gy + C * gz);
    float y = by * (B * gx + (a * c - e * e) * gy + (d * e - a * f) * gz);
    float z = by * (C * gx + (d * e - a * f) * gy + (a * b - d * d) * gz);
    float h = 2 / (1 + x * x + y * y + z * z);
    float Q[9] = {1 - h * (y * y + z * z), h * (x * y - z), h * (x * z + y),
                  h * (x * y + z), 1 - h * (x * x + z * z), h * (y * z - x),
                  h * (x * z - y), h * (y * z + x), 1 - h * (x * x + y * y)};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) T[3 * i + j] = R[3 * i] * Q[j] + R[3 * i + 1] * Q[3 + j] + R[3 * i + 2] * Q[6 + j];
    for (int i = 0; i < 9; i++) R[i] = T[i];
}

/* Iterations over `clusters` whose members are member[start[c]] to member[start[c + 1]], and `particles` whose clusters are
   of[of_start[i]] to of[of_start[i + 1]]; R (clusters, 9) and T (clusters, 3) are their frames, x (particles, 3) goes on. */
void match(int threads, int iterations, float step, int clusters, const int *start, const int *member, int particles,
           const int *of_start, const int *of, const vec *rest, const vec *centre0, const float *weight, float *R, vec *T,
           vec *x) {
#pragma omp parallel num_threads(threads)
    for (int iteration = 0; iteration < iterations; iteration++) {
#pragma omp for schedule(static)
        for (int c = 0; c < clusters; c++) {
            const float *origin = x[member[start[c]]];
            float M[9] = {0}, mean[3] = {0}, total = 0;
            for (int k = start[c]; k < start[c + 1]; k++) {
                int i = member[k];
                float w = weight[i];
                total += w;
                for (int a = 0; a < 3; a++) {
                    float p = w * (x[i][a] - origin[a]);
                    mean[a] += p;
                    for (int b = 0; b < 3; b++) M[3 * a + b] += p * (rest[i][b] - centre0[c][b]);
                }
            }
            turn(R + 9 * c, M);
            for (int a = 0; a < 3; a++)
                T[c][a] = origin[a] + mean[a] / total - R[9 * c + 3 * a] * centre0[c][0] -
                          R[9 * c + 3 * a + 1] * centre0[c][1] - R[9 * c + 3 * a + 2] * centre0[c][2];
        }
#pragma omp for schedule(static)
        for (int i = 0; i < particles; i++) {
            float F[9] = {0}, t[3] = {0};
            for (int k = of_start[i]; k < of_start[i + 1]; k++) {
                for (int a = 0; a < 9; a++) F[a] += R[9 * of[k] + a];
                for (int a = 0; a < 3; a++) t[a] += T[of[k]][a];
            }
            float share = 1.0f / (of_start[i + 1] - of_start[i]);
            for (int a = 0; a < 3; a++) {
                float goal = F[3 * a] * rest[i][0] + F[3 * a + 1] * rest[i][1] + F[3 * a + 2] * rest[i][2] + t[a];
                x[i][a] += step * (share * goal - x[i][a]);
            }
        }
    }
}
