// Real spherical harmonics of degree 1 to DEGREE, in 3DGS's order and signs, without the constant.

#define SH_C0 0.28209479177387814
#define COEFFICIENTS ((DEGREE + 1) * (DEGREE + 1) - 1)
#define HARMONIC_TEXELS ((COEFFICIENTS + 3) / 4)

#if DEGREE > 0
void harmonicBasis(vec3 d, out float b[COEFFICIENTS]) {
    float x = d.x, y = d.y, z = d.z;
    b[0] = -0.4886025119029199 * y;
    b[1] = 0.4886025119029199 * z;
    b[2] = -0.4886025119029199 * x;
#if DEGREE > 1
    float xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    b[3] = 1.0925484305920792 * xy;
    b[4] = -1.0925484305920792 * yz;
    b[5] = 0.31539156525252005 * (2.0 * zz - xx - yy);
    b[6] = -1.0925484305920792 * xz;
    b[7] = 0.5462742152960395 * (xx - yy);
#endif
#if DEGREE > 2
    b[8] = -0.5900435899266435 * y * (3.0 * xx - yy);
    b[9] = 2.890611442640554 * xy * z;
    b[10] = -0.4570457994644658 * y * (4.0 * zz - xx - yy);
    b[11] = 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
    b[12] = -0.4570457994644658 * x * (4.0 * zz - xx - yy);
    b[13] = 1.445305721320277 * z * (xx - yy);
    b[14] = -0.5900435899266435 * x * (xx - 3.0 * yy);
#endif
#if DEGREE > 3
    b[15] = 2.5033429417967046 * xy * (xx - yy);
    b[16] = -1.7701307697799304 * yz * (3.0 * xx - yy);
    b[17] = 0.9461746957575601 * xy * (7.0 * zz - 1.0);
    b[18] = -0.6690465435572892 * yz * (7.0 * zz - 3.0);
    b[19] = 0.10578554691520431 * (zz * (35.0 * zz - 30.0) + 3.0);
    b[20] = -0.6690465435572892 * xz * (7.0 * zz - 3.0);
    b[21] = 0.47308734787878004 * (xx - yy) * (7.0 * zz - 1.0);
    b[22] = -1.7701307697799304 * xz * (xx - 3.0 * yy);
    b[23] = 0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy));
#endif
}
#endif
